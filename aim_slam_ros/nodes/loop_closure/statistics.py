"""What the loop-closure node says of itself on /diagnostics."""

from __future__ import annotations

import time

from ..memory import memory_mb
from .map_session import MapSession


class LoopClosureStatistics:
    """Counters since the start; each is written by one thread alone."""

    def __init__(self) -> None:
        self.unusable_messages = 0      # refused by their adapter
        self.unusable_keyframes = 0     # refused by the pose graph, or failed in the pipeline
        self.dropped_keyframes = 0      # the queue was full
        self.latency_s = 0.0            # of the last keyframe, from its arrival until it was done
        self._heard_s: float | None = None

    def hear(self) -> None:
        """A message of the frontend came."""
        self._heard_s = time.monotonic()

    @property
    def silence_s(self) -> float | None:
        """Since the last message; None before the first."""
        return None if self._heard_s is None else time.monotonic() - self._heard_s

    def values(self) -> dict[str, str | float | int]:
        """Everything, by name."""
        return {'keyframe_latency_s': self.latency_s,
                'unusable_messages': self.unusable_messages,
                'unusable_keyframes': self.unusable_keyframes,
                'dropped_keyframes': self.dropped_keyframes, 'memory_mb': memory_mb()}


def map_values(session: MapSession | None) -> dict[str, str | float | int]:
    """What there is of a map, by name."""
    if session is None:
        return {'session': 'none', 'keyframes': 0, 'missing_keyframes': 0, 'map_pieces': 0,
                'frames': 0, 'map_version': 0, 'loops': 0, 'rejected': 0}
    pipeline = session.pipeline
    rejected = pipeline.rejected
    return {'session': session.session_id, 'keyframes': session.keyframes,
            'missing_keyframes': session.gaps.missing, 'map_pieces': session.pieces,
            'frames': len(session.path), 'map_version': pipeline.version,
            'loops': len(pipeline.loops), 'rejected': sum(rejected.values()),
            **{f'rejected: {reason}': count for reason, count in rejected.items()}}
