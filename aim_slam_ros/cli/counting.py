"""How far something is that is only counted, on stderr."""

from __future__ import annotations

import sys
from contextlib import contextmanager
from typing import Callable, Iterator

from tqdm import tqdm

_PLAIN_STEPS = 10


@contextmanager
def counter(total: int, unit: str) -> Iterator[Callable[[], object]]:
    """Call it for every ``unit`` done: a bar in a terminal, a few plain lines in a log."""
    if not sys.stderr.isatty():
        yield _plain(total, unit)
        return
    with tqdm(total=total, unit=unit, dynamic_ncols=True) as bar:
        yield bar.update


def _plain(total: int, unit: str) -> Callable[[], object]:
    done = 0

    def advance() -> None:
        nonlocal done
        done += 1
        if done * _PLAIN_STEPS // total > (done - 1) * _PLAIN_STEPS // total:
            whole = f'/{total}' if done <= total else ''    # more in a second round
            print(f'{done}{whole} {unit}s', file=sys.stderr, flush=True)
    return advance
