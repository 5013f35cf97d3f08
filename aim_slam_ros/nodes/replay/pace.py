"""When the messages of a bag are due, and the /clock that says so."""

from __future__ import annotations

import threading
import time
from typing import Callable

_SECOND_NS = 1_000_000_000


class Pace:
    """Maps times of a bag to now, beginning when it is made.

    start_ns: the time of the bag that is now. tick: called clock_hz times per second with the
    bag's time; 0: never.
    """

    def __init__(self, start_ns: int, rate: float, clock_hz: float, tick: Callable[[int], None],
                 stop: threading.Event) -> None:
        self._start_ns = start_ns
        self._rate = rate
        self._period_ns = int(_SECOND_NS / clock_hz) if clock_hz else 0
        self._tick = tick
        self._stop = stop
        self._began_ns = self._next_tick_ns = time.monotonic_ns()

    def wait_for(self, log_ns: int) -> int:
        """Sleep until this time of the bag, or until told to stop; how late it is then [ns]."""
        due_ns = self._began_ns + int((log_ns - self._start_ns) / self._rate)
        while True:
            now_ns = time.monotonic_ns()
            if self._period_ns and now_ns >= self._next_tick_ns:
                self._tick(self._start_ns + int((now_ns - self._began_ns) * self._rate))
                # After a pause of the process: on from here, rather than all ticks at once.
                self._next_tick_ns = max(self._next_tick_ns, now_ns - self._period_ns) \
                    + self._period_ns
            if now_ns >= due_ns or self._stop.is_set():
                return now_ns - due_ns
            wake_ns = min(due_ns, self._next_tick_ns) if self._period_ns else due_ns
            self._stop.wait(max(wake_ns - now_ns, 0) / _SECOND_NS)
