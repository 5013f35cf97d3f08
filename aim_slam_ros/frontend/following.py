"""A pose for every image, from optical flow of the keyframes' points: no inference needed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Sequence

import numpy as np
import torch
from torch import Tensor

from ..config import FollowingConfig
from ..geometry import camera, sim3
from ..registration.flow import LEVELS, TIGHT_LEVELS, TIGHT_ROUND_TRIP_PX, refine
from ..registration.rigid import RigidSolution, solve_rigid, solve_rigid_from_scratch
from ..types import Keyframe
from .landmarks import LandmarkCache

_SEARCH_PX = 90.0      # how far a point may be from a prediction by motion alone
_SEARCH_POINTS = 80    # strongest corners of a reference that are searched that far
_SEARCH_MIN = 20       # found points below which the search says nothing
_TIGHT_PX = 12.0       # and from the prediction by a pose that is nearly right
# Of the first reference's points in the image explained: the motion was as expected.
_CONVINCING = 0.6
_OUTVOTED = 0.3        # a smaller share of the first reference: the others may contradict it


@dataclass(frozen=True)
class Followed:
    """ok: the pose can be trusted. T_world_cam: [4,4] rigid.

    fractions: by reference id, the share of its points that were found and explained; the first
    reference's is matched_fraction. points_world [M,3], uv [M,2]: what was found and explained.
    """

    ok: bool
    T_world_cam: Tensor
    matched_fraction: float
    fractions: dict[int, float]
    points_world: np.ndarray
    uv: np.ndarray
    reason: str = ''

    @property
    def reference_id(self) -> int:
        """The keyframe that it was followed against first."""
        return next(iter(self.fractions))


@dataclass(frozen=True)
class _Found:
    """Points of all references found in the image, one row each.

    searched: how many of the first reference's were predicted there.
    """

    searched: int
    owner: np.ndarray
    points_world: np.ndarray
    spread_world: np.ndarray
    uv: np.ndarray

    def share_of_first(self, solution: RigidSolution) -> float:
        """How much of the first reference that should be in the image the pose explains."""
        return int((self.owner[solution.inliers] == 0).sum()) / max(1, self.searched)


class Follower:
    """Finds the camera of an image among the keyframes it is followed against."""

    def __init__(self, config: FollowingConfig, landmarks: LandmarkCache) -> None:
        self._config = config
        self._landmarks = landmarks

    def follow(self, grey: np.ndarray, K: Tensor, T_world_cam_guess: Tensor,
               references: Sequence[Keyframe]) -> Followed:
        """references: the one that counts for matched_fraction first. K: [3,3] of the image.

        Where the pose hardly explains that one, it alone: before a loop is closed the others may
        be where the camera passed long ago, and the drift since then stands between them.
        """
        followed = self._against(references, grey, K, T_world_cam_guess)
        if len(references) == 1 or followed.matched_fraction >= _OUTVOTED:
            return followed
        alone = self._against(references[:1], grey, K, T_world_cam_guess)
        return alone if alone.ok and alone.matched_fraction > followed.matched_fraction \
            else followed

    def _against(self, references: Sequence[Keyframe], grey: np.ndarray, K: Tensor,
                 T_world_cam_guess: Tensor) -> Followed:
        found = self._find(grey, K, T_world_cam_guess, references, wide=False)
        solution = self._solve(found, K, T_world_cam_guess, self._config.min_inliers)
        if solution is None or found.share_of_first(solution) < _CONVINCING:
            T_world_cam = self._searched(grey, K, T_world_cam_guess, references)
            found = self._find(grey, K, T_world_cam, references, wide=False)
            solution = self._solve(found, K, T_world_cam, self._config.min_inliers)
        return self._followed(found, solution, T_world_cam_guess, references)

    def _searched(self, grey: np.ndarray, K: Tensor, T_world_cam: Tensor,
                  references: Sequence[Keyframe]) -> Tensor:
        """Roughly where the camera is after a motion that nobody expected."""
        found = self._find(grey, K, T_world_cam, references, wide=True)
        solution = self._solve(found, K, T_world_cam, _SEARCH_MIN)
        return T_world_cam if solution is None else sim3.inverse(solution.T_cam_ref)

    def _find(self, grey: np.ndarray, K: Tensor, T_world_cam: Tensor,
              references: Sequence[Keyframe], wide: bool) -> _Found:
        """Wide: a few points, far around; else all of them, near their predictions."""
        searched = 0
        owners, points, spreads, pixels = [], [], [], []
        T_cam_world = sim3.inverse(T_world_cam)
        for index, keyframe in enumerate(references):
            landmarks = self._landmarks.of(keyframe)
            if wide:
                landmarks = landmarks.strongest(_SEARCH_POINTS)
            sigma = landmarks.relative_sigma(self._config.sigma_depth)
            T = keyframe.T_world_kf.numpy()
            world = landmarks.points @ T[:3, :3].T + T[:3, 3]
            uv = camera.project(sim3.transform(T_cam_world, torch.from_numpy(world)), K).numpy()
            matches = refine(keyframe.frame.grey, grey, landmarks.uv, uv,
                             _SEARCH_PX if wide else _TIGHT_PX,
                             None if wide else TIGHT_ROUND_TRIP_PX,
                             LEVELS if wide else TIGHT_LEVELS)
            searched = searched if index else matches.searched
            hit = matches.valid
            owners.append(np.full(int(hit.sum()), index))
            points.append(world[hit])
            spreads.append((world[hit] - T[:3, 3]) * sigma[hit, None])
            pixels.append(matches.uv_b[hit])
        return _Found(searched, np.concatenate(owners), np.concatenate(points),
                      np.concatenate(spreads), np.concatenate(pixels))

    def _solve(self, found: _Found, K: Tensor, T_world_cam: Tensor,
               at_least: int) -> RigidSolution | None:
        """From the guess, or where that explains too little, from scratch."""
        if len(found.uv) < at_least:
            return None
        best = None
        for T_cam_world in (sim3.inverse(T_world_cam), None):
            if T_cam_world is None:
                T_cam_world = solve_rigid_from_scratch(found.points_world, found.uv, K)
                if T_cam_world is None:
                    break
            solution = solve_rigid(found.points_world, found.uv, K, T_cam_world,
                                   found.spread_world, self._config.sigma_px)
            if best is None or solution.inliers.sum() > best.inliers.sum():
                best = solution
            if best.inliers.mean() >= self._config.min_inlier_ratio:
                break
        return best

    def _followed(self, found: _Found, solution: RigidSolution | None, T_guess: Tensor,
                  references: Sequence[Keyframe]) -> Followed:
        if solution is None:
            return _nothing(T_guess, f'only {len(found.uv)} points were found again')
        inliers = solution.inliers
        explained = int(inliers.sum())
        fractions = {
            keyframe.keyframe_id: float((found.owner[inliers] == index).sum())
            / max(1, len(self._landmarks.of(keyframe).uv))
            for index, keyframe in enumerate(references)}
        reason = ''
        if explained < self._config.min_inliers:
            reason = f'a pose explains only {explained} points'
        elif inliers.mean() < self._config.min_inlier_ratio:
            reason = f'a pose explains only {explained} of {len(inliers)} found points'
        return Followed(not reason, sim3.inverse(solution.T_cam_ref),
                        fractions[references[0].keyframe_id], fractions,
                        found.points_world[inliers], found.uv[inliers], reason)


def _nothing(T_world_cam: Tensor, reason: str) -> Followed:
    return Followed(False, T_world_cam, 0.0, {}, np.zeros((0, 3)), np.zeros((0, 2)), reason)
