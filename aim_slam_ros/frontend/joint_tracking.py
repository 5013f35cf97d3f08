"""The paper's tracker: one Sim(3) solve over the whole window (paper, joint optimisation).

Matches come from the current inference, points from the stored keyframes, so that the two carry
different information. Measured, the image tracker does better; this one
is kept to be compared, and because another model may shift the balance.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ..config import JointTrackingConfig
from ..geometry import camera, rays, sim3
from ..types import GUESSED_CONFIDENCE, Keyframe
from . import joint_solver
from .alignment import pose_mean
from .joint_residuals import PairMatches
from .tracking import TrackingResult, TrackingWindow

# The guess is a median over thousands of depths; a solve that leaves it this far has collapsed.
MAX_SCALE_CHANGE = 2.0


@dataclass(frozen=True)
class _View:
    """One view of the window, in the map's geometry and in the inference's.

    points, confidence: [H,W,3] and [H,W], what is optimised, in the view's own unit.
    predicted: [H,W,3], what is matched, in the inference's unit. T_first_cam: in the inference.
    T_world: Sim(3) in the map; for the current frame a guess. at: [M] flat indices of the
    confident grid points, out of ``offered``. observations: None for the current frame.
    """

    points: Tensor
    confidence: Tensor
    predicted: Tensor
    K: Tensor
    K_predicted: Tensor
    T_first_cam: Tensor
    T_world: Tensor
    at: Tensor
    offered: int
    observations: int | None


class JointTracker:
    """Optimises the relative poses of all views of the window; the earliest keyframe is fixed."""

    def __init__(self, config: JointTrackingConfig) -> None:
        self._config = config

    def track(self, window: TrackingWindow) -> TrackingResult:
        """Place the current frame; ``T_world_frame_guess`` is not used: the paper has none.

        Raises ValueError where a keyframe's pointmap and the prediction differ in size.
        """
        _check(window)
        if not window.keyframes:
            return _failed('there is no keyframe in the window')
        if window.prediction.rotation_only:
            return _failed('the views differ by a rotation alone: their depth is not measured')
        guess = pose_mean(window, self._config.min_match_fraction)
        if guess is None:
            return _failed('the prediction and the keyframes share no depth that was seen')
        order = sorted(range(len(window.keyframes)), key=lambda k: window.keyframes[k].stamp_ns)
        views = [self._keyframe_view(window, k) for k in order]
        views.append(self._current_view(window, guess))
        pairs = self._pairs(views)
        shares = [len(pair.q) / views[-1].offered for pair in pairs if pair.j == len(order)]
        if max(shares) < self._config.min_match_fraction:
            return _failed(f'no keyframe shares more than {max(shares):.0%} of the frame',
                           max(shares))
        return self._solve([window.keyframes[k] for k in order], views, pairs, max(shares))

    def _solve(self, keyframes: list[Keyframe], views: list[_View],
               pairs: tuple[PairMatches, ...], share: float) -> TrackingResult:
        T_world = torch.stack([view.T_world for view in views])
        links = sim3.inverse(T_world[:-1]) @ T_world[1:]
        solution = joint_solver.solve(links, pairs, self._config)
        solved = [sim3.on_group(T) for T in itertools.accumulate(
            solution.links, torch.matmul, initial=T_world[0])]
        growth = float(sim3.scale_of(solved[-1]) / sim3.scale_of(T_world[-1]))
        if not 1.0 / MAX_SCALE_CHANGE < growth < MAX_SCALE_CHANGE:
            return _failed(f'the scale strayed from its guess by a factor of {growth:.2g}', share)
        moved = {kf.keyframe_id: T for kf, T in zip(keyframes[1:], solved[1:])}
        return TrackingResult(True, solved[-1], solution.kappa, share, moved)

    def _keyframe_view(self, window: TrackingWindow, k: int) -> _View:
        keyframe, prediction = window.keyframes[k], window.prediction
        at = self._grid(keyframe.confidence, keyframe.points_cam)
        return _View(keyframe.points_cam, keyframe.confidence,
                     camera.unproject(prediction.depth[k + 1], prediction.K[k + 1]),
                     keyframe.K, prediction.K[k + 1], prediction.T_first_cam[k + 1],
                     keyframe.T_world_kf, at, self._offered(keyframe.confidence),
                     keyframe.observations)

    def _current_view(self, window: TrackingWindow, guess: Tensor) -> _View:
        prediction = window.prediction
        points = camera.unproject(prediction.depth[0], prediction.K[0])
        at = self._grid(prediction.confidence[0], points)
        return _View(points, prediction.confidence[0], points, prediction.K[0], prediction.K[0],
                     prediction.T_first_cam[0], guess, at,
                     self._offered(prediction.confidence[0]), None)

    def _offered(self, confidence: Tensor) -> int:
        return max(1, len(_grid_indices(confidence, self._config.stride)))

    def _grid(self, confidence: Tensor, points: Tensor) -> Tensor:
        """Flat indices [M] of the grid points that were seen, in front and confident enough."""
        at = _grid_indices(confidence, self._config.stride)
        at = at[torch.isfinite(confidence.reshape(-1)[at])
                & (confidence.reshape(-1)[at] > GUESSED_CONFIDENCE)
                & (points.reshape(-1, 3)[at, 2] > 0)]
        values = confidence.reshape(-1)[at]
        if len(values) == 0:
            return at
        return at[values >= torch.quantile(values, self._config.confidence_quantile)]

    def _pairs(self, views: list[_View]) -> tuple[PairMatches, ...]:
        reach = 1 if self._config.pairs == 'adjacent' else 2
        return tuple(self._match(views, i, j) for j in range(1, len(views))
                     for i in range(max(0, j - reach), j))

    def _match(self, views: list[_View], i: int, j: int) -> PairMatches:
        """Matches by the inference's geometry; a pair that shares too little has none."""
        view_i, view_j = views[i], views[j]
        T_i_j = sim3.inverse(view_i.T_first_cam) @ view_j.T_first_cam
        X = sim3.transform(T_i_j, view_j.predicted.reshape(-1, 3)[view_j.at])
        matches = rays.match_rays(view_i.predicted, X, view_i.K_predicted, iterations=0)
        # On one ray, distances are to each other as depths.
        occlusion = torch.log(matches.points_i[:, 2] / X[:, 2]).abs()
        points_i = rays.sample(view_i.points, matches.uv_i)
        confidence_i = rays.sample(view_i.confidence[..., None], matches.uv_i)[:, 0]
        q = (confidence_i * view_j.confidence.reshape(-1)[view_j.at]).sqrt()
        keep = matches.valid & (occlusion < self._config.depth_tolerance)
        keep &= (points_i[:, 2] > 0) & (confidence_i > GUESSED_CONFIDENCE)
        if int(keep.sum()) < self._config.min_match_fraction * view_j.offered:
            keep = torch.zeros_like(keep)
        at, q = view_j.at[keep], q[keep]
        return PairMatches(
            i, j, view_j.points.reshape(-1, 3)[at], points_i[keep], q / q.mean(),
            view_i.K, math.hypot(*view_i.confidence.shape), _median_depth(view_i),
            sim3.inverse(view_i.T_world) @ view_j.T_world, self._observations(view_i, view_j))

    def _observations(self, view_i: _View, view_j: _View) -> float | None:
        """How often the pair can have been observed, or None where it has no past."""
        if view_i.observations is None or view_j.observations is None:
            return None
        return self._config.memory * min(view_i.observations, view_j.observations)


def _grid_indices(image: Tensor, stride: int) -> Tensor:
    return camera.grid_indices(*image.shape, stride, str(image.device))


def _median_depth(view: _View) -> float:
    depth = view.points.reshape(-1, 3)[view.at, 2]
    return float(depth.median()) if len(depth) else 1.0


def _check(window: TrackingWindow) -> None:
    size = window.prediction.depth.shape
    if size[0] != len(window.keyframes) + 1:
        raise ValueError(f'the prediction has {size[0]} views for a frame and '
                         f'{len(window.keyframes)} keyframes: infer the window that is tracked')
    for keyframe in window.keyframes:
        if keyframe.confidence.shape != size[1:]:
            raise ValueError(
                f'keyframe {keyframe.keyframe_id} is {tuple(keyframe.confidence.shape)} and the '
                f'prediction {tuple(size[1:])}: keep one image size per map')


def _failed(reason: str, share: float = 0.0) -> TrackingResult:
    return TrackingResult(False, sim3.identity(), math.inf, share, reason=reason)
