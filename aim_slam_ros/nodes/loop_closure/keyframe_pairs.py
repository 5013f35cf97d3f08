"""A keyframe comes as two messages with the same stamp; either may be first, or alone."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any, Callable

from msg_adapters.stamps import stamp_ns

_WAITING = 10       # of each kind; some megabytes each
_TOGETHER_S = 5.0   # two that belong together come within; else one of an earlier pair was lost


@dataclass(frozen=True)
class KeyframePair:
    table: Any
    cloud: Any


@dataclass(frozen=True)
class _Waiting:
    message: Any
    since_s: float


class KeyframePairs:
    """Brings tables and clouds together by their stamps.

    A keyframe is told more than once: what waits too long is not of the same time as what comes.
    """

    def __init__(self, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._clock_s = clock_s
        self._tables: dict[int, _Waiting] = {}
        self._clouds: dict[int, _Waiting] = {}
        self.unpaired = 0       # messages given up because their counterpart never came

    def table(self, message: Any) -> KeyframePair | None:
        """The pair, if the cloud is there already."""
        cloud = self._match(message, self._tables, self._clouds)
        return None if cloud is None else KeyframePair(message, cloud)

    def cloud(self, message: Any) -> KeyframePair | None:
        """The pair, if the table is there already."""
        table = self._match(message, self._clouds, self._tables)
        return None if table is None else KeyframePair(table, message)

    def _match(self, message: Any, own: dict[int, _Waiting],
               other: dict[int, _Waiting]) -> Any:
        stamp, now_s = stamp_ns(message.header.stamp), self._clock_s()
        found = other.pop(stamp, None)
        if found is not None and now_s - found.since_s <= _TOGETHER_S:
            return found.message
        self.unpaired += found is not None
        own.pop(stamp, None)        # a resent one takes the place of the first
        own[stamp] = _Waiting(message, now_s)
        if len(own) > _WAITING:
            own.pop(next(iter(own)))
            self.unpaired += 1
        return None
