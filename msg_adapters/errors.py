"""What a message that cannot be used is answered with."""

from __future__ import annotations


class MessageError(ValueError):
    """A message that does not say what it should; the text says what is wrong and what to do."""
