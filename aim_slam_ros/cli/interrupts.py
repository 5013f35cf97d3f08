"""Ctrl-C, once."""

from __future__ import annotations

import signal
from contextlib import contextmanager
from types import FrameType
from typing import Iterator

INTERRUPTED = 130       # exit status
_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def one_interrupt() -> Iterator[None]:
    """SIGINT or SIGTERM raises KeyboardInterrupt, the first time.

    From then on both are ignored, until the end of the process: what is left to do is cleaning up.
    """
    told = False

    def interrupt(number: int, frame: FrameType | None) -> None:
        nonlocal told
        told = True
        for each in _SIGNALS:
            signal.signal(each, signal.SIG_IGN)
        raise KeyboardInterrupt

    before = [signal.signal(number, interrupt) for number in _SIGNALS]
    try:
        yield
    finally:
        if not told:
            for number, handler in zip(_SIGNALS, before):
                signal.signal(number, handler)
