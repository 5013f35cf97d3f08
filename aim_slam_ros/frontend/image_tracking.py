"""The default tracker: the inference predicts dense matches, the images refine them.

Matches that come from the inference whose poses are then optimised carry no new information
(measured), so the prediction is only where the search in the images starts.
"""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import torch
from torch import Tensor

from ..config import FollowingConfig, TrackingConfig
from ..geometry import camera, sim3
from ..registration.rigid import RigidSolution, solve_rigid
from ..registration.scale import log_depth_ratio
from .alignment import pose_mean
from .landmarks import matched_grid
from .matching import PredictedMatches, predict_matches
from .tracking import TrackingResult, TrackingWindow


class ImageTracker:
    """Rigid part from refined matches of stored points, scale from depth ratios."""

    def __init__(self, config: TrackingConfig, following: FollowingConfig,
                 min_seen: float) -> None:
        self._config = config
        self._following = following
        self._min_seen = min_seen
        self._landmarks = matched_grid(config.stride)

    def track(self, window: TrackingWindow) -> TrackingResult:
        """Keyframes stay where they are. Fails where neither model nor images place the frame."""
        modelled = pose_mean(window, self._min_seen)
        guess = modelled if window.T_world_frame_guess is None else window.T_world_frame_guess
        if guess is None:
            return _failed('the model connected the image with no keyframe of its window')
        rigid_start = sim3.rigid_part(guess)
        matches, solution = self._refined(window, rigid_start)
        if solution is None or self._strays(rigid_start, solution, matches):
            return _fallback(window, matches, modelled)
        scale = self._scale(window, matches, solution.T_cam_ref, solution.inliers)
        if not scale:
            return _fallback(window, matches, modelled)
        return TrackingResult(
            True, sim3.with_scale(sim3.inverse(solution.T_cam_ref), scale),
            self._kappa(window, matches, solution, modelled),
            matches.best_fraction(solution.inliers),
            measured=partial(self._measured, window, matches, solution))

    def _refined(self, window: TrackingWindow,
                 T_world_cam: Tensor) -> tuple[PredictedMatches, RigidSolution | None]:
        K = window.prediction.K[0]
        matches = predict_matches(window.keyframes, self._landmarks, window.frame.grey, K,
                                  T_world_cam, self._following.sigma_depth)
        if len(matches.uv) < self._config.min_matches:
            return matches, None
        return matches, solve_rigid(matches.points_world, matches.uv, K,
                                    sim3.inverse(T_world_cam), matches.spread_world,
                                    self._config.sigma_px)

    def _strays(self, T_start: Tensor, solution: RigidSolution,
                matches: PredictedMatches) -> bool:
        """Whether the solve left the basin that its matches were predicted in."""
        T_world_cam = sim3.inverse(solution.T_cam_ref)
        depth = sim3.transform(solution.T_cam_ref, torch.from_numpy(matches.points_world))[:, 2]
        moved = float((T_world_cam - T_start)[:3, 3].norm()) / max(float(depth.median()), 1e-9)
        return moved > self._config.max_stray \
            or solution.inliers.sum() < self._config.min_matches

    def _scale(self, window: TrackingWindow, matches: PredictedMatches, T_cam_world: Tensor,
               rows: np.ndarray) -> float:
        """From the prediction's unit to the world's, at these matches; 0 where unknown."""
        z = sim3.transform(T_cam_world, torch.from_numpy(matches.points_world[rows]))[:, 2]
        u, v = np.rint(matches.uv[rows]).astype(np.int64).T
        predicted = window.prediction.depth[0][v, u].cpu()
        weight = (window.prediction.confidence[0][v, u].cpu() - 1.0).clamp_min(0.0)
        ratio = log_depth_ratio(z, predicted,
                                weight.sqrt() * torch.from_numpy(matches.weight[rows]))
        return ratio.scale if ratio.count else 0.0

    def _kappa(self, window: TrackingWindow, matches: PredictedMatches, solution: RigidSolution,
               T_world_frame: Tensor | None) -> float:
        """Reduced chi-square of the matches at the pose that the model gives the image.

        How well the window's inference explains the images. After the solve only the noise of
        the matches is left, which says nothing of the model and does not fall with more views.
        """
        if T_world_frame is None:
            return math.inf
        rows = solution.inliers
        points = sim3.transform(sim3.inverse(sim3.rigid_part(T_world_frame)),
                                torch.from_numpy(matches.points_world[rows]))
        uv = camera.project(points, window.prediction.K[0])
        squared = (uv - torch.from_numpy(matches.uv[rows])).square().sum(-1)
        squared = squared[torch.isfinite(squared)]      # behind the camera there is no pixel
        freedom = 2 * len(squared) - 6
        return float(squared.sum()) / (freedom * self._config.sigma_model_px ** 2) \
            if freedom > 0 else math.inf

    def _measured(self, window: TrackingWindow, matches: PredictedMatches,
                  joint: RigidSolution) -> dict[int, Tensor]:
        """T_kf_frame of each keyframe that has matches enough for a solution of its own."""
        measured = {}
        for index, keyframe in enumerate(window.keyframes):
            rows = np.flatnonzero((matches.owner == index) & joint.inliers)
            if len(rows) < self._config.min_matches:
                continue
            alone = solve_rigid(matches.points_world[rows], matches.uv[rows],
                                window.prediction.K[0], joint.T_cam_ref,
                                matches.spread_world[rows], self._config.sigma_px, iterations=3)
            scale = self._scale(window, matches, alone.T_cam_ref, rows)
            if scale:
                measured[keyframe.keyframe_id] = sim3.inverse(keyframe.T_world_kf) \
                    @ sim3.with_scale(sim3.inverse(alone.T_cam_ref), scale)
        return measured


def _fallback(window: TrackingWindow, matches: PredictedMatches,
              modelled: Tensor | None) -> TrackingResult:
    """Where the images add nothing: the pose it was followed to, else the model's own."""
    if modelled is None:
        return _failed(f'only {len(matches.uv)} matches were found in the images and the '
                       'model did not connect the window')
    guess = window.T_world_frame_guess
    T = modelled if guess is None else sim3.with_scale(guess, sim3.scale_of(modelled))
    return TrackingResult(True, T, math.inf, matches.best_fraction(None), optimised=False)


def _failed(reason: str) -> TrackingResult:
    return TrackingResult(False, sim3.identity(), math.inf, 0.0, reason=reason)
