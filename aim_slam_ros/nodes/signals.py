"""SIGINT and SIGTERM: the first begins the end, which is then bounded in time."""

from __future__ import annotations

import os
import signal
import sys
import threading
from contextlib import contextmanager
from types import FrameType
from typing import Collection, Iterator

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_END = b'\0'             # no signal's number
_DEADLINE_S = 2.0       # from the first signal until the process is gone, whatever it does


class StopSignals:
    """Takes over both signals for the rest of the process.

    A thread is woken by the C part of Python's signal handling, so that the deadline also holds
    while the main thread is inside a long computation.
    """

    def __init__(self) -> None:
        self.told = False
        self._status = 0
        self._interrupt = False
        self._read, self._write = os.pipe()
        os.set_blocking(self._write, False)
        threading.Thread(target=self._watch, name='deadline', daemon=True).start()
        for number in _SIGNALS:
            signal.signal(number, self._on_signal)
        signal.set_wakeup_fd(self._write, warn_on_full_buffer=False)

    @contextmanager
    def interrupting(self) -> Iterator[None]:
        """Within, a signal raises KeyboardInterrupt instead of waiting to be looked at."""
        self._interrupt = True
        try:
            yield
            if self.told:
                raise KeyboardInterrupt
        finally:
            self._interrupt = False

    def end(self, status: int = 0) -> None:
        """From now on the process has until the deadline to be gone, with this exit status."""
        self.told = True
        self._status = status
        os.write(self._write, _END)

    def leave(self, threads: Collection[threading.Thread], status: int) -> None:
        """Leave the process here and now if one of these threads is still at work.

        The interpreter's own end would wait for it, or pull the ground from under it.
        """
        if any(thread.is_alive() for thread in threads):
            _exit(status)
        for number in _SIGNALS:     # the interpreter's end gives handlers back, this it leaves
            signal.signal(number, signal.SIG_IGN)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if self.told:
            return
        self.told = True
        if self._interrupt:
            raise KeyboardInterrupt

    def _watch(self) -> None:
        # Each signal that has a handler in Python arrives here as its number.
        while os.read(self._read, 1) not in (_END, *(bytes([number]) for number in _SIGNALS)):
            pass
        threading.Event().wait(_DEADLINE_S)
        _exit(self._status)


def _exit(status: int) -> None:
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)
