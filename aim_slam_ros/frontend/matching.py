"""Dense matches of keyframes with an image: predicted by geometry, refined in the images."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Sequence

import numpy as np
import torch
from torch import Tensor

from ..geometry import camera, sim3
from ..registration.flow import TIGHT_LEVELS, refine
from ..types import GUESSED_CONFIDENCE, Keyframe
from .landmarks import relative_depth_sigma


@dataclass(frozen=True)
class PredictedMatches:
    """M matches of the keyframes' grid points with the image.

    owner: [M] index of the keyframe. offered: [keyframes], how many grid points each had.
    points_world, spread_world: [M,3] float64, the point and one standard deviation of its depth.
    uv: [M,2] where the image has it. weight: [M] inverse relative depth deviation.
    """

    owner: np.ndarray
    offered: np.ndarray
    points_world: np.ndarray
    spread_world: np.ndarray
    uv: np.ndarray
    weight: np.ndarray

    def best_fraction(self, inliers: np.ndarray | None) -> float:
        """The largest share of one keyframe's grid that was matched (and is an inlier)."""
        owner = self.owner if inliers is None else self.owner[inliers]
        hits = np.bincount(owner, minlength=len(self.offered))
        return float((hits / np.maximum(self.offered, 1)).max()) if len(hits) else 0.0


def predict_matches(keyframes: Sequence[Keyframe], grey: np.ndarray, K: Tensor,
                    T_world_cam: Tensor, stride: int, sigma_depth: float) -> PredictedMatches:
    """Project every stride-th seen point of each keyframe into the image and refine it there."""
    parts = [_of_one(k, grey, K, T_world_cam, stride, sigma_depth) for k in keyframes]
    owner = np.concatenate([np.full(len(p[1]), i) for i, p in enumerate(parts)])
    columns = [np.concatenate([p[i] for p in parts]) for i in range(1, 5)]
    return PredictedMatches(owner, np.array([p[0] for p in parts]), *columns)


def _of_one(keyframe: Keyframe, grey: np.ndarray, K: Tensor, T_world_cam: Tensor, stride: int,
            sigma_depth: float) -> tuple[int, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Grid points offered, and per match: point, spread (world), pixel, weight."""
    width = keyframe.frame.width
    at = camera.grid_indices(keyframe.frame.height, width, stride, str(keyframe.confidence.device))
    confidence = keyframe.confidence.reshape(-1).index_select(0, at).cpu()
    points = keyframe.points_cam.reshape(-1, 3).index_select(0, at).cpu()
    seen = confidence >= torch.quantile(confidence, 0.2).clamp_min(GUESSED_CONFIDENCE)
    at, confidence, points = at.cpu()[seen], confidence[seen], points[seen].double()
    uv_kf = torch.stack([at % width, at // width], -1).float().numpy()
    sigma = relative_depth_sigma(confidence, keyframe.mean_confidence, sigma_depth).double()
    world = sim3.transform(keyframe.T_world_kf, points)
    uv = camera.project(sim3.transform(sim3.inverse(T_world_cam), world), K).numpy()
    found = refine(keyframe.frame.grey, grey, uv_kf, uv, levels=TIGHT_LEVELS)
    hit = torch.from_numpy(found.valid)
    spread = (world - sim3.translation_of(keyframe.T_world_kf)) * sigma[:, None]
    return (len(uv_kf), world[hit].numpy(), spread[hit].numpy(), found.uv_b[found.valid],
            (1.0 / sigma[hit]).numpy())
