"""Loop candidates by the similarity of image descriptors (paper, loop closure: top-2 cosine)."""

from __future__ import annotations

from dataclasses import dataclass
from statistics import median
from typing import AbstractSet

import torch
from torch import Tensor

from ..config import LoopClosureConfig

_FIRST_CAPACITY = 64


class RetrievalError(ValueError):
    """A descriptor that cannot be compared with the stored ones."""


@dataclass(frozen=True)
class Candidate:
    """similarity: cosine, -1 to 1."""

    keyframe_id: int
    similarity: float


class Retrieval:
    """The descriptors of all keyframes.

    What a similarity is worth differs between descriptors and scenes. So a candidate is measured
    on the way from the background (the median over all keyframes) to what the best of the
    keyframe's own neighbours scores.
    """

    def __init__(self, config: LoopClosureConfig) -> None:
        self._config = config
        self._ids: list[int] = []
        self._row: dict[int, int] = {}
        self._descriptors = torch.empty(0, 0)
        self._past_references: list[float] = []

    def __len__(self) -> int:
        return len(self._ids)

    def add(self, keyframe_id: int, descriptor: Tensor) -> None:
        """Store a descriptor [D], normalised here. Raises RetrievalError where it is no match."""
        size = self._descriptors.shape[1] if self._ids else descriptor.numel()
        if descriptor.shape != (size,) or not bool(descriptor.isfinite().all()):
            raise RetrievalError(
                f'the descriptor of keyframe {keyframe_id} is not {size} finite numbers but has '
                f'shape {tuple(descriptor.shape)}; all must come from the same geometry model')
        self._make_room(size)
        row = descriptor.detach().to('cpu', torch.float32)
        self._descriptors[len(self._ids)] = row / row.norm().clamp_min(1e-12)
        self._row[keyframe_id] = len(self._ids)
        self._ids.append(keyframe_id)

    def candidates(self, keyframe_id: int,
                   neighbourhood: AbstractSet[int]) -> tuple[Candidate, ...]:
        """The most similar stored keyframes outside the neighbourhood, the best first.

        neighbourhood: keyframes that see the same anyway; what they score is the reference.
        """
        stored = self._descriptors[:len(self._ids)]
        similarity = stored @ stored[self._row[keyframe_id]]
        near = torch.zeros(len(self._ids), dtype=torch.bool)
        near[[self._row[k] for k in neighbourhood if k in self._row]] = True
        itself = torch.arange(len(self._ids)) == self._row[keyframe_id]
        threshold = self._threshold(similarity[~itself], similarity[near & ~itself])
        scores = similarity.masked_fill(near | itself, -torch.inf)
        best = scores.topk(min(self._config.candidates, len(self._ids)))
        return tuple(Candidate(self._ids[row], score)
                     for score, row in zip(best.values.tolist(), best.indices.tolist())
                     if score >= threshold)

    def _threshold(self, others: Tensor, near: Tensor) -> float:
        """Nothing passes where even the neighbours do not stand out from the background."""
        if near.numel():
            self._past_references.append(float(near.max()))
        if not self._past_references or not others.numel():
            return float('inf')
        # The first keyframe of a map piece has no neighbours: take what was usual so far.
        reference = self._past_references[-1] if near.numel() else median(self._past_references)
        background = float(others.median())
        if reference <= background:
            return float('inf')
        return background + self._config.similarity * (reference - background)

    def _make_room(self, size: int) -> None:
        """Double the storage when it is full, so that adding costs constant time on average."""
        capacity = self._descriptors.shape[0]
        if len(self._ids) < capacity:
            return
        grown = torch.empty(max(_FIRST_CAPACITY, 2 * capacity), size)
        if capacity:
            grown[:capacity] = self._descriptors
        self._descriptors = grown
