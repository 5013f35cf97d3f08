"""Nodes of this package as processes of the operating system."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Iterable, Mapping, Sequence

import aim_slam_ros

_PACKAGE = 'aim_slam_ros'
_LIBC = ctypes.CDLL(None)
_PR_SET_PDEATHSIG = 1
# A node gives itself 2 s to end; the rest is for the interpreter on a machine that is busy.
_GRACE_S = 5.0
_TAIL_LINES = 12
_CLEAN = (0, 128 + signal.SIGINT, -signal.SIGINT)


@dataclass(frozen=True)
class Ended:
    """How a process ended. code: as subprocess has it, negative for a signal."""

    name: str
    code: int
    killed: bool
    traceback: bool
    log: Path

    @property
    def problem(self) -> str | None:
        """What went wrong, for a person; None for a clean end."""
        if self.killed:
            what = 'did not end in time after SIGINT and was killed'
        elif self.traceback:
            what = 'left a traceback in its log'
        elif self.code not in _CLEAN:
            what = f'ended with status {self.code}'
        else:
            return None
        return f'{self.name} {what}: see {self.log}'


class NodeProcess:
    """One node, in its own process group: Ctrl-C in the terminal is for the one who started it."""

    def __init__(self, name: str, command: Sequence[str], log: Path,
                 environment: Mapping[str, str]) -> None:
        """log: gets what it prints; an earlier file is replaced."""
        self.name = name
        self.log = log
        self._killed = False
        with log.open('wb') as output:
            # The preexec function runs in the child: nothing survives a parent that was killed.
            self._process = subprocess.Popen(
                command, stdout=output, stderr=subprocess.STDOUT,
                stdin=subprocess.DEVNULL, env=_with_package(environment), process_group=0,
                preexec_fn=_end_with_parent)

    @property
    def alive(self) -> bool:
        return self._process.poll() is None

    @property
    def code(self) -> int | None:
        """The exit status, negative for a signal; None while it runs."""
        return self._process.poll()

    def tail(self) -> str:
        """The last lines of what it printed."""
        lines = self._printed().splitlines()
        return '\n'.join(lines[-_TAIL_LINES:])

    def interrupt(self) -> None:
        """Ask it to end; once, since it may take a second time for impatience."""
        if self.alive:
            self._process.send_signal(signal.SIGINT)

    def end_before(self, deadline_s: float) -> Ended:
        """Wait until then (time.monotonic) and kill what still runs."""
        try:
            code = self._process.wait(max(deadline_s - time.monotonic(), 0.0))
        except subprocess.TimeoutExpired:
            self._killed = True
            self._process.kill()
            code = self._process.wait()
        return Ended(self.name, code, self._killed, 'Traceback (most recent call' in
                     self._printed(), self.log)

    def _printed(self) -> str:
        return self.log.read_text(encoding='utf-8', errors='replace')


def stop(processes: Iterable[NodeProcess], grace_s: float = _GRACE_S) -> tuple[Ended, ...]:
    """End them, all at the same time."""
    chosen = list(processes)
    for process in chosen:
        process.interrupt()
    deadline_s = time.monotonic() + grace_s
    return tuple(process.end_before(deadline_s) for process in chosen)


def executable(name: str) -> list[str]:
    """How to start an executable of this package: the built one, or its module in the sources.

    The interpreter is this one: an executable's own first line would take the first in PATH.
    """
    for folder in _executables():
        if (folder / name).is_file():
            return [sys.executable, str(folder / name)]
    return [sys.executable, '-m', f'{_PACKAGE}.cli.{name}']


def _executables() -> list[Path]:
    """Where `ros2 run` looks, beside the program that runs and in the prefix of this module."""
    folders = [Path(sys.argv[0]).absolute().parent] if sys.argv[0] else []
    prefixes = [parent for parent in Path(__file__).resolve().parents if parent.name == 'lib']
    folders += [prefix / _PACKAGE for prefix in prefixes]
    return [folder for folder in folders if folder.parts[-2:] == ('lib', _PACKAGE)]


def _with_package(environment: Mapping[str, str]) -> dict[str, str]:
    """The environment in which the child imports the package that this process runs."""
    assert aim_slam_ros.__file__ is not None
    root = str(Path(aim_slam_ros.__file__).resolve().parents[1])
    path = environment.get('PYTHONPATH')
    return {**environment, 'PYTHONPATH': os.pathsep.join([root, *([path] if path else [])])}


def _end_with_parent() -> None:
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
