"""How images and poses travelled between processes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Mapping

import numpy as np

_PERCENTILES = (50, 95, 99)


@dataclass(frozen=True)
class Traffic:
    """What was heard on one topic: how many messages and their serialised size together."""

    messages: int
    size_bytes: int


@dataclass(frozen=True)
class Delivery:
    """What only a run over topics has.

    latency_ms: [N] float64, from the publication of an image to the arrival of its pose; poses
    of images that had to wait for the map to begin are counted in ``late_poses`` instead.
    topics: by the name of the topic.
    """

    latency_ms: np.ndarray
    late_poses: int
    topics: Mapping[str, Traffic] = field(default_factory=dict)

    def figures(self) -> dict[str, float | int | None]:
        """Latency percentiles (None without a pose) and the messages, by their metric's name."""
        known = len(self.latency_ms) > 0
        out: dict[str, float | int | None] = {
            f'latency_ms_p{p}': float(np.percentile(self.latency_ms, p)) if known else None
            for p in _PERCENTILES}
        out['latency_ms_max'] = float(self.latency_ms.max()) if known else None
        out['late_poses'] = self.late_poses
        for topic, traffic in self.topics.items():
            name = topic.strip('/').replace('/', '_')
            out[f'messages_{name}'] = traffic.messages
            out[f'message_size_{name}_kb'] = traffic.size_bytes / max(traffic.messages, 1) / 1e3
        return out
