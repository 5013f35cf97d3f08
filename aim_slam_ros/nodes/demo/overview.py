"""How far both nodes are, for a person."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Mapping

from msg_adapters import frames
from msg_adapters.keyframes import keyframe_placement

from .collector import Heard, Topic

# What the nodes call their statuses on /diagnostics: '<full name of the node>: <this>'.
FRONTEND, LOOP_CLOSURE = 'tracking', 'loop closure'


@dataclass(frozen=True)
class Overview:
    """state: of the image that was answered last. dropped: as the frontend counts them."""

    state: str
    keyframes: int
    loops: int
    dropped: int

    def __str__(self) -> str:
        return (f'{self.state}, {self.keyframes} keyframes, {self.loops} loops, '
                f'{self.dropped} dropped')


NOTHING = Overview('no answer yet', 0, 0, 0)


def overview(topics: Mapping[str, Topic]) -> Overview:
    """Everything until now; reads three messages."""
    row = topics['frame'].read_newest()
    if row is None:
        return NOTHING
    report = frames.frame_report(row)
    return Overview(report.result.status.value, _keyframes(topics['keyframe']),
                    int(newest_status(topics, LOOP_CLOSURE).values.get('loops', 0)),
                    report.dropped)


def _keyframes(topic: Topic) -> int:
    """Ids count from 0, and of those told together the new one is the last."""
    table = topic.read_newest()
    return 0 if table is None else keyframe_placement(table).poses[0].keyframe_id + 1


@dataclass(frozen=True)
class Status:
    """What a node says of itself. arrival_ns: of time.monotonic_ns; 0: it has not said a word."""

    arrival_ns: int
    values: Mapping[str, str]


def newest_status(topics: Mapping[str, Topic], what: str) -> Status:
    """The newest of FRONTEND or LOOP_CLOSURE."""
    topic = topics['/diagnostics']
    for heard in reversed(topic.heard):
        values = _values(topic, heard, what)
        if values:
            return Status(heard.arrival_ns, values)
    return Status(0, {})


def _values(topic: Topic, heard: Heard, what: str) -> dict[str, str]:
    return {pair.key: pair.value for status in topic.read(heard).status
            if status.name.endswith(f': {what}') for pair in status.values}
