"""What the frontend says of itself on /diagnostics."""

from __future__ import annotations

import math
import threading
import time
from collections import Counter, deque
from typing import Iterable

from ...types import FrameResult, TrackingStatus
from ..memory import memory_mb

_SPAN_S = 5.0       # rates and latencies are of so many last seconds


class FrontendStatistics:
    """Counters of a session and rates of the last seconds; two threads write it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._arrivals: deque[float] = deque()
        self._poses: deque[tuple[float, float]] = deque()
        self.received = self.dropped = self.resets = 0
        self.model_errors = self.errors = 0
        self.counts: Counter[TrackingStatus] = Counter()
        self.last: FrameResult | None = None
        self.reason = ''
        self._window, self._kappa, self._inferences = 0, math.nan, 0

    def arrived(self, replaced: bool) -> None:
        """An image came; replaced: the one before was never looked at."""
        with self._lock:
            self.received += 1
            self.dropped += replaced
            self._arrivals.append(time.monotonic())

    def took(self, result: FrameResult, again: bool) -> None:
        """A result; again: of an image that was counted before."""
        self._inferences += result.inferences
        if result.window:
            self._window = len(result.window) + 1
            self._kappa = math.nan if result.kappa is None else result.kappa
        if not again:
            self.counts[result.status] += 1
            self.last = result
            self.reason = result.reason

    def posed(self, arrived_s: float) -> None:
        """A pose left, of an image that came at this time."""
        now = time.monotonic()
        with self._lock:
            self._poses.append((now, now - arrived_s))

    def values(self) -> dict[str, str | float | int]:
        """Everything, by name."""
        with self._lock:
            since = time.monotonic() - _SPAN_S
            _forget(self._arrivals, (s for s in self._arrivals), since)
            _forget(self._poses, (s for s, _ in self._poses), since)
            latencies = sorted(1e3 * latency for _, latency in self._poses)
            rates = len(self._arrivals) / _SPAN_S, len(self._poses) / _SPAN_S
        return {
            'state': 'waiting for images' if self.last is None else self.last.status.value,
            'image_rate_hz': rates[0], 'pose_rate_hz': rates[1],
            'latency_ms_median': _quantile(latencies, 0.5),
            'latency_ms_p95': _quantile(latencies, 0.95),
            'images_received': self.received, 'images_dropped': self.dropped,
            **{f'images_{status.value}': self.counts[status] for status in TrackingStatus},
            'inferences': self._inferences, 'window': self._window, 'kappa': self._kappa,
            'model_errors': self.model_errors, 'errors': self.errors, 'resets': self.resets,
            'memory_mb': memory_mb()}


def _forget(entries: deque, times: Iterable[float], since: float) -> None:
    for _ in range(sum(moment < since for moment in times)):
        entries.popleft()


def _quantile(ordered: list[float], share: float) -> float:
    return ordered[min(int(share * len(ordered)), len(ordered) - 1)] if ordered else math.nan
