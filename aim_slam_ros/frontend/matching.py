"""Dense matches of keyframes with an image: predicted by geometry, refined in the images."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Sequence

import numpy as np
import torch
from torch import Tensor

from ..geometry import camera, sim3
from ..registration.flow import SMALL_PX, TIGHT_LEVELS, TIGHT_ROUND_TRIP_PX, refine
from ..types import Keyframe
from .landmarks import LandmarkCache, Landmarks


@dataclass(frozen=True)
class PredictedMatches:
    """M matches of the keyframes' grid points with the image.

    owner: [M] index of the keyframe. offered: [keyframes], how many landmarks each had.
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
        """The largest share of one keyframe's landmarks that was matched (and is an inlier)."""
        owner = self.owner if inliers is None else self.owner[inliers]
        hits = np.bincount(owner, minlength=len(self.offered))
        return float((hits / np.maximum(self.offered, 1)).max()) if len(hits) else 0.0


def predict_matches(keyframes: Sequence[Keyframe], landmarks: LandmarkCache, grey: np.ndarray,
                    K: Tensor, T_world_cam: Tensor, sigma_depth: float) -> PredictedMatches:
    """Project each keyframe's landmarks, as far as seen, into the image and refine them there."""
    parts = [_of_one(k, landmarks.of(k).seen(), grey, K, T_world_cam, sigma_depth)
             for k in keyframes]
    owner = np.concatenate([np.full(len(p[1]), i) for i, p in enumerate(parts)])
    columns = [np.concatenate([p[i] for p in parts]) for i in range(1, 5)]
    return PredictedMatches(owner, np.array([p[0] for p in parts]), *columns)


def _of_one(keyframe: Keyframe, landmarks: Landmarks, grey: np.ndarray, K: Tensor,
            T_world_cam: Tensor, sigma_depth: float
            ) -> tuple[int, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Landmarks offered, and per match: point, spread (world), pixel, weight."""
    sigma = landmarks.relative_sigma(sigma_depth)
    world = sim3.transform(keyframe.T_world_kf, torch.from_numpy(landmarks.points))
    uv = camera.project(sim3.transform(sim3.inverse(T_world_cam), world), K).numpy()
    found = refine(keyframe.frame.grey, grey, landmarks.uv, uv,
                   max_round_trip_px=TIGHT_ROUND_TRIP_PX, levels=TIGHT_LEVELS, window_px=SMALL_PX)
    hit = found.valid
    points = world.numpy()[hit]
    spread = (points - keyframe.T_world_kf[:3, 3].numpy()) * sigma[hit, None]
    return len(landmarks.uv), points, spread, found.uv_b[hit], 1.0 / sigma[hit]
