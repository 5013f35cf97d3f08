"""The points of a keyframe that images are followed by."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from ..config import FollowingConfig
from ..types import GUESSED_CONFIDENCE, Keyframe

_CACHED = 64
_SIGMA_GUESSED = 0.5   # relative standard deviation of a guessed depth


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
    """Corners of one keyframe. uv: [N,2] float32 px."""

    uv: np.ndarray

    def strongest(self, count: int) -> Landmarks:
        """The corners come in order of strength."""
        return Landmarks(self.uv[:count])

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

    def __init__(self, config: FollowingConfig) -> None:
        self._config = config
        self._cache: OrderedDict[int, Landmarks] = OrderedDict()

    def of(self, keyframe: Keyframe) -> Landmarks:
        found = self._cache.pop(keyframe.keyframe_id, None)
        if found is None:
            found = self._detect(keyframe)
        self._cache[keyframe.keyframe_id] = found
        if len(self._cache) > _CACHED:
            self._cache.popitem(last=False)
        return found

    def _detect(self, keyframe: Keyframe) -> Landmarks:
        grey = keyframe.frame.grey
        # Corners whose depth is among the worst known would only vote for a wrong pose.
        floor = float(torch.quantile(keyframe.confidence[::4, ::4].reshape(-1), 0.2))
        mask = (keyframe.confidence >= floor).cpu().numpy().astype(np.uint8)
        mask[:8], mask[-8:], mask[:, :8], mask[:, -8:] = 0, 0, 0, 0
        corners = cv2.goodFeaturesToTrack(grey, self._config.points, 0.003,
                                          self._config.spacing_px, mask=mask)
        uv = np.zeros((0, 2), np.float32) if corners is None else corners[:, 0]
        return Landmarks(uv)
