"""How often something is published that is only worth it after a change."""

from __future__ import annotations

import time

_MAX_SHARE = 0.25       # of the time may be spent on it


class Pacer:
    """Due once something has changed, but not more often than the period, nor than it can pay."""

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._changed = False
        self._due_s = self._began_s = 0.0

    def change(self) -> None:
        self._changed = True

    def due(self, grace_s: float = 0.0) -> bool:
        """Whether it is time; with grace, only if it has been for so long."""
        return self._changed and time.monotonic() >= self._due_s + grace_s

    def begin(self) -> None:
        """What changes from now on is for the next time."""
        self._changed = False
        self._began_s = time.monotonic()

    def end(self) -> None:
        cost_s = time.monotonic() - self._began_s
        self._due_s = self._began_s + max(self._period_s, cost_s / _MAX_SHARE)
