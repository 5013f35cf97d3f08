"""Runs side by side, each in a process of its own: one that dies takes no other with it."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from typing import Callable, Sequence

from aim_slam_ros.ablation.runs import Run, RunFolder
from aim_slam_ros.config import ConfigError

# torch takes seconds to import and its threads are set before: what needs it is imported in the
# processes, not here.

_REFUSED = 2
# What numpy's, scipy's and torch's libraries read when they are loaded.
_THREADS = ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS')

Finished = Callable[[Run, int], None]


def cores() -> int:
    """How many this process may use."""
    return len(os.sched_getaffinity(0))


def run_all(runs: Sequence[Run], folder: RunFolder, at_once: int, finished: Finished) -> None:
    """Every run, ``at_once`` of them at a time; what they give is in the folder.

    finished: called with each run as it ends and the exit status of its process, 0 when all is
    well; the process has said on stderr what was wrong. An interrupt ends those that are under
    way, which leave nothing behind.
    """
    threads = max(1, cores() // at_once)
    context = multiprocessing.get_context('spawn')
    waiting, working = list(reversed(runs)), dict[int, tuple[Run, BaseProcess]]()
    try:
        while waiting or working:
            while waiting and len(working) < at_once:
                run = waiting.pop()
                process: BaseProcess = context.Process(
                    target=run_one, args=(run, folder, threads), daemon=True)
                process.start()
                working[process.sentinel] = (run, process)
            _collect(working, finished)
    finally:
        for _, process in working.values():
            process.kill()
        for _, process in working.values():
            process.join()


def _collect(working: dict[int, tuple[Run, BaseProcess]], finished: Finished) -> None:
    """Wait until at least one of them ends."""
    for sentinel in wait(list(working)):
        assert isinstance(sentinel, int)
        run, process = working.pop(sentinel)
        process.join()
        finished(run, process.exitcode or 0)


def run_one(run: Run, folder: RunFolder, threads: int) -> None:
    """What a process does."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)    # Ctrl-C goes to all: the parent decides
    os.environ.update({name: str(threads) for name in _THREADS})
    from aim_slam_ros.ablation.running import figures_of, limit_threads
    from aim_slam_ros.datasets import DatasetError
    limit_threads(threads)
    try:
        folder.write(run, figures_of(run))
    except (ConfigError, DatasetError) as error:
        print(f'ablate: {error}', file=sys.stderr)
        sys.exit(_REFUSED)
