"""A keyframe comes as two messages with the same stamp; either may be first, or alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from msg_adapters.stamps import stamp_ns

_WAITING = 10       # of each kind; some megabytes each


@dataclass(frozen=True)
class KeyframePair:
    table: Any
    cloud: Any


class KeyframePairs:
    """Brings tables and clouds together by their stamps."""

    def __init__(self) -> None:
        self._tables: dict[int, Any] = {}
        self._clouds: dict[int, Any] = {}
        self.unpaired = 0       # messages given up because their counterpart never came

    def table(self, message: Any) -> KeyframePair | None:
        """The pair, if the cloud is there already."""
        cloud = self._match(message, self._tables, self._clouds)
        return None if cloud is None else KeyframePair(message, cloud)

    def cloud(self, message: Any) -> KeyframePair | None:
        """The pair, if the table is there already."""
        table = self._match(message, self._clouds, self._tables)
        return None if table is None else KeyframePair(table, message)

    def _match(self, message: Any, own: dict[int, Any], other: dict[int, Any]) -> Any:
        stamp = stamp_ns(message.header.stamp)
        found = other.pop(stamp, None)
        if found is None:
            own.pop(stamp, None)        # a resent one takes the place of the first
            own[stamp] = message
            if len(own) > _WAITING:
                own.pop(next(iter(own)))
                self.unpaired += 1
        return found
