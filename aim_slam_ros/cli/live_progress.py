"""How far a bag is that both nodes listen to, on stderr."""

from __future__ import annotations

import sys
from contextlib import contextmanager
from typing import TYPE_CHECKING, Iterator

from tqdm import tqdm

if TYPE_CHECKING:
    from aim_slam_ros.nodes.demo.live_run import Listener
    from aim_slam_ros.nodes.demo.overview import Overview

_PLAIN_STEPS = 10


@contextmanager
def live_progress(total: int) -> Iterator[Listener]:
    """A bar in a terminal, a few plain lines in a log; total: images of the bag."""
    if not sys.stderr.isatty():
        yield _Lines(total)
        return
    with tqdm(total=total, unit='image', dynamic_ncols=True) as bar:
        yield _Bar(bar)


class _Bar:

    def __init__(self, bar: tqdm) -> None:
        self._bar = bar

    def say(self, text: str) -> None:
        self._bar.write(text, file=sys.stderr)

    def show(self, overview: Overview) -> None:
        self._bar.set_postfix_str(str(overview), refresh=False)
        self._bar.update()


class _Lines:

    def __init__(self, total: int) -> None:
        self._total = total
        self._done = 0

    def say(self, text: str) -> None:
        print(text, file=sys.stderr, flush=True)

    def show(self, overview: Overview) -> None:
        self._done += 1
        steps = [done * _PLAIN_STEPS // self._total for done in (self._done - 1, self._done)]
        if steps[1] > steps[0]:
            self.say(f'{self._done}/{self._total} images, {overview}')
