"""The points of a keyframe that are looked for in images."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, replace
from functools import partial
from typing import Callable

import cv2
import numpy as np
import torch
from torch import Tensor

from ..config import FollowingConfig
from ..types import GUESSED_CONFIDENCE, Keyframe

_CACHED = 64
_SIGMA_GUESSED = 0.5   # relative standard deviation of a guessed depth
_UNSURE = 0.2          # this share of a keyframe, its least confident pixels, has no landmarks
_BORDER_PX = 8         # nor have its borders: a patch needs some room
_TEXTURE_PX = 9        # side of the patch whose texture counts
_EDGE_PX = 9           # depths differ by more than this factor within such a square at an edge
_EDGE_FACTOR = 1.1


def relative_depth_sigma(confidence: Tensor, mean_confidence: float,
                         sigma_at_mean: float) -> Tensor:
    """Relative standard deviation of depths with these confidences [...].

    The scale of confidences differs between models and grows as observations are fused, so only
    their ratio to the keyframe's mean counts.
    """
    ratio = (confidence - 1.0).clamp_min(1e-6) / max(mean_confidence - 1.0, 1e-6)
    sigma = (sigma_at_mean / ratio.sqrt()).clamp(0.4 * sigma_at_mean, _SIGMA_GUESSED)
    return sigma.masked_fill(confidence < GUESSED_CONFIDENCE, _SIGMA_GUESSED)


@dataclass(frozen=True)
class Landmarks:
    """N points of one keyframe as it is known by now, in the computer's memory.

    uv: [N,2] float32 px. points: [N,3] float64 in the keyframe's unit. confidence: [N].
    mean_confidence: the whole keyframe's.
    """

    uv: np.ndarray
    points: np.ndarray
    confidence: Tensor
    mean_confidence: float

    def strongest(self, count: int) -> Landmarks:
        """Corners come in order of strength."""
        return self._only(slice(count))

    def seen(self) -> Landmarks:
        """Those of the better part; none with a guessed depth."""
        least = torch.quantile(self.confidence, _UNSURE).clamp_min(GUESSED_CONFIDENCE) \
            if len(self.confidence) else GUESSED_CONFIDENCE
        return self._only((self.confidence >= least).numpy())

    def relative_sigma(self, sigma_at_mean: float) -> np.ndarray:
        """[N] relative standard deviation of their depths."""
        return relative_depth_sigma(self.confidence, self.mean_confidence, sigma_at_mean).numpy()

    def _only(self, rows: slice | np.ndarray) -> Landmarks:
        return replace(self, uv=self.uv[rows], points=self.points[rows],
                       confidence=self.confidence[rows])


@dataclass(frozen=True)
class _Cached:
    observations: int
    landmarks: Landmarks


class LandmarkCache:
    """Landmarks by keyframe id; the least recently used are dropped and can be made again.

    What is known of them is read once for each of the keyframe's observations: pointmaps may be on
    a GPU, where a read would wait for the inference that is under way.
    """

    def __init__(self, choose: Callable[[Keyframe], np.ndarray]) -> None:
        """choose: their pixels [N,2], kept while the keyframe learns."""
        self._choose = choose
        self._cache: OrderedDict[int, _Cached] = OrderedDict()

    def of(self, keyframe: Keyframe) -> Landmarks:
        cached = self._cache.pop(keyframe.keyframe_id, None)
        if cached is None or cached.observations != keyframe.observations:
            uv = self._choose(keyframe) if cached is None else cached.landmarks.uv
            cached = _Cached(keyframe.observations, _known(keyframe, uv))
        self._cache[keyframe.keyframe_id] = cached
        if len(self._cache) > _CACHED:
            self._cache.popitem(last=False)
        return cached.landmarks


def _known(keyframe: Keyframe, uv: np.ndarray) -> Landmarks:
    u, v = np.rint(uv).astype(np.int64).T
    return Landmarks(uv, keyframe.points_cam[v, u].cpu().double().numpy(),
                     keyframe.confidence[v, u].cpu(), keyframe.mean_confidence)


def followed_corners(config: FollowingConfig) -> LandmarkCache:
    """The strongest corners: few, for every image."""
    return LandmarkCache(partial(_corners, config))


def matched_grid(stride_px: int) -> LandmarkCache:
    """One point in each square of that side (px at a width of 518): all over the keyframe.

    The pixel with the most texture there that is neither at a depth edge nor of the least
    confident: where the image cannot be matched or the depth not be right, a point only adds noise
    (measured: a regular grid has twice the error in the rendered corridor).
    """
    return LandmarkCache(partial(_best_of_squares, stride_px))


def _corners(config: FollowingConfig, keyframe: Keyframe) -> np.ndarray:
    mask = (~_unsure(keyframe)).astype(np.uint8)
    mask[:_BORDER_PX], mask[-_BORDER_PX:] = 0, 0
    mask[:, :_BORDER_PX], mask[:, -_BORDER_PX:] = 0, 0
    corners = cv2.goodFeaturesToTrack(keyframe.frame.grey, config.points, 0.003,
                                      config.spacing_px, mask=mask)
    return np.zeros((0, 2), np.float32) if corners is None else corners[:, 0]


def _best_of_squares(stride_px: int, keyframe: Keyframe) -> np.ndarray:
    # As many in a small image: a solve needs their number, not their distance.
    side = max(1, round(stride_px * keyframe.frame.width / 518.0))
    texture = cv2.cornerMinEigenVal(keyframe.frame.grey, _TEXTURE_PX)
    score = texture / max(float(texture.max()), 1e-12) - _at_depth_edge(keyframe)
    score -= 2.0 * _unsure(keyframe)
    rows, columns = (length // side for length in score.shape)
    top, left = ((length - n * side) // 2 for length, n in zip(score.shape, (rows, columns)))
    squares = score[top:top + rows * side, left:left + columns * side] \
        .reshape(rows, side, columns, side).transpose(0, 2, 1, 3).reshape(rows, columns, -1)
    v, u = np.divmod(squares.argmax(-1), side)
    v += top + side * np.arange(rows)[:, None]
    u += left + side * np.arange(columns)
    return np.stack([u, v], -1).reshape(-1, 2).astype(np.float32)


def _unsure(keyframe: Keyframe) -> np.ndarray:
    """[H,W] bool: the depth is among the worst known, and would only vote for a wrong pose."""
    least = torch.quantile(keyframe.confidence[::4, ::4].reshape(-1), _UNSURE)
    unsure: np.ndarray = (keyframe.confidence < least).cpu().numpy()
    return unsure


def _at_depth_edge(keyframe: Keyframe) -> np.ndarray:
    """[H,W] bool: near and far side by side, so that a model's depth is between the two."""
    depth = keyframe.points_cam[..., 2].cpu().numpy()
    around = np.ones((_EDGE_PX, _EDGE_PX), np.uint8)
    edge: np.ndarray = cv2.dilate(depth, around) > _EDGE_FACTOR * cv2.erode(depth, around)
    return edge
