"""Which keyframes join the last one in a window: SIGMA's order, and recency to compare with."""

from __future__ import annotations

from typing import Protocol, Sequence

from ..config import SigmaConfig
from ..types import Keyframe
from .keyframe_map import KeyframeMap
from .sigma import rerank


class Prioritiser(Protocol):
    """Orders candidates; how many of them are taken is decided elsewhere."""

    def ranked(self, last: Keyframe, keyframes: KeyframeMap) -> tuple[int, ...]:
        """Ids of the keyframes of its map piece that may join the last one, best first."""

    def reranked(self, last: Keyframe, remaining: Sequence[Keyframe]) -> tuple[int, ...]:
        """The candidates that have not joined yet, after an optimisation.

        last: the keyframe as that optimisation would leave it.
        """


class InformationPrioritiser:
    """Those that share most voxels, by the information that they add (paper, SIGMA a and b)."""

    def __init__(self, config: SigmaConfig) -> None:
        self._config = config

    def ranked(self, last: Keyframe, keyframes: KeyframeMap) -> tuple[int, ...]:
        return self.reranked(last, keyframes.overlapping(last.keyframe_id))

    def reranked(self, last: Keyframe, remaining: Sequence[Keyframe]) -> tuple[int, ...]:
        return tuple(r.keyframe_id for r in rerank(last, remaining, self._config))


class RecencyPrioritiser:
    """The newest, whatever they see: what a sliding window would take."""

    def __init__(self, config: SigmaConfig) -> None:
        self._config = config

    def ranked(self, last: Keyframe, keyframes: KeyframeMap) -> tuple[int, ...]:
        others = [k for k in keyframes.piece if k.keyframe_id != last.keyframe_id]
        return self.reranked(last, others)[:self._config.candidates]

    def reranked(self, last: Keyframe, remaining: Sequence[Keyframe]) -> tuple[int, ...]:
        return tuple(sorted((k.keyframe_id for k in remaining), reverse=True))


def make_prioritiser(config: SigmaConfig) -> Prioritiser:
    """The one that the settings name."""
    if config.prioritiser == 'recency':
        return RecencyPrioritiser(config)
    return InformationPrioritiser(config)
