"""The points of a keyframe that are looked for in images."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
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
    """Points of one keyframe. uv: [N,2] float32 px."""

    uv: np.ndarray

    def strongest(self, count: int) -> Landmarks:
        """Corners come in order of strength."""
        return Landmarks(self.uv[:count])

    def seen(self, keyframe: Keyframe) -> Landmarks:
        """Those of the better part, as the keyframe is known now; none with a guessed depth."""
        u, v = self._pixels()
        confidence = keyframe.confidence[v, u].cpu()
        least = torch.quantile(confidence, _UNSURE).clamp_min(GUESSED_CONFIDENCE) \
            if len(confidence) else GUESSED_CONFIDENCE
        return Landmarks(self.uv[(confidence >= least).numpy()])

    def points(self, keyframe: Keyframe) -> np.ndarray:
        """[N,3] float64 in the keyframe's unit, from its pointmap as it is now."""
        u, v = self._pixels()
        return keyframe.points_cam[v, u].cpu().double().numpy()

    def relative_sigma(self, keyframe: Keyframe, sigma_at_mean: float) -> np.ndarray:
        """[N] relative standard deviation of their depths."""
        u, v = self._pixels()
        return relative_depth_sigma(keyframe.confidence[v, u].cpu(), keyframe.mean_confidence,
                                    sigma_at_mean).numpy()

    def _pixels(self) -> tuple[np.ndarray, np.ndarray]:
        whole = np.rint(self.uv).astype(np.int64)
        return whole[:, 0], whole[:, 1]


class LandmarkCache:
    """Landmarks by keyframe id; the least recently used are dropped and can be made again."""

    def __init__(self, choose: Callable[[Keyframe], Landmarks]) -> None:
        self._choose = choose
        self._cache: OrderedDict[int, Landmarks] = OrderedDict()

    def of(self, keyframe: Keyframe) -> Landmarks:
        found = self._cache.pop(keyframe.keyframe_id, None)
        if found is None:
            found = self._choose(keyframe)
        self._cache[keyframe.keyframe_id] = found
        if len(self._cache) > _CACHED:
            self._cache.popitem(last=False)
        return found


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


def _corners(config: FollowingConfig, keyframe: Keyframe) -> Landmarks:
    mask = (~_unsure(keyframe)).astype(np.uint8)
    mask[:_BORDER_PX], mask[-_BORDER_PX:] = 0, 0
    mask[:, :_BORDER_PX], mask[:, -_BORDER_PX:] = 0, 0
    corners = cv2.goodFeaturesToTrack(keyframe.frame.grey, config.points, 0.003,
                                      config.spacing_px, mask=mask)
    return Landmarks(np.zeros((0, 2), np.float32) if corners is None else corners[:, 0])


def _best_of_squares(stride_px: int, keyframe: Keyframe) -> Landmarks:
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
    return Landmarks(np.stack([u, v], -1).reshape(-1, 2).astype(np.float32))


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
