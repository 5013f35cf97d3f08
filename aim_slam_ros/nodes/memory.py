"""How much memory this process holds."""

from __future__ import annotations

import resource
from pathlib import Path

_MEGABYTE = 2 ** 20


def memory_mb() -> float:
    """Resident memory."""
    pages = int(Path('/proc/self/statm').read_text(encoding='ascii').split()[1])
    return pages * resource.getpagesize() / _MEGABYTE
