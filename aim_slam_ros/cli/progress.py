"""How far a run is, on stderr."""

from __future__ import annotations

import sys
from contextlib import contextmanager
from typing import Callable, Iterator

from tqdm import tqdm

from aim_slam_ros.types import FrameResult

Progress = Callable[[FrameResult | None], None]
_PLAIN_STEPS = 10


@contextmanager
def progress_bar(total: int) -> Iterator[Progress]:
    """Call it with every result: a bar in a terminal, a few plain lines in a log."""
    if not sys.stderr.isatty():
        yield _plain(total)
        return
    with tqdm(total=total, unit='image', dynamic_ncols=True) as bar:
        def advance(result: FrameResult | None) -> None:
            bar.set_postfix_str(_status(result), refresh=False)
            bar.update()
        yield advance


def _plain(total: int) -> Progress:
    done = 0

    def advance(result: FrameResult | None) -> None:
        nonlocal done
        done += 1
        if done * _PLAIN_STEPS // total > (done - 1) * _PLAIN_STEPS // total:
            print(f'{done}/{total} images, {_status(result)}', file=sys.stderr, flush=True)
    return advance


def _status(result: FrameResult | None) -> str:
    return 'unreadable' if result is None else result.status.value
