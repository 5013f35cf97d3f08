"""From where to look at a map so that a person recognises it."""

from __future__ import annotations

import numpy as np

from aim_slam_ros.types import StampedPoses

_TILT = 0.5         # cosine of the largest mean camera tilt at which +z still counts as up
_LONG_PATH = 0.5    # path length over map extent above which the path is what there is to see
_STEADY_LOOK = 0.3  # length of the mean viewing direction below which cameras look all around


def view_axes(poses: StampedPoses, points: np.ndarray, *, surveyed: bool) -> np.ndarray:
    """[3,3]: rows are right, away and up of a viewer who stands where the cameras stand.

    poses: at least one. points: [N,3], in the same frame. surveyed: the frame is a ground
    truth's, whose axes somebody chose; else it is the first camera's and only images tell up.
    """
    up = _up(poses, surveyed)
    away = _away(poses, points, up)
    return np.stack([np.cross(away, up), away, up])


def _up(poses: StampedPoses, surveyed: bool) -> np.ndarray:
    """[3] unit: people hold cameras upright, so up in the images is up in the mean.

    Ground truth has z up (motion capture, surveying) or follows a camera (KITTI, 7-Scenes).
    """
    mean = -poses.T_world_cam[:, :3, 1].mean(0)
    mean /= max(np.linalg.norm(mean), 1e-9)
    if not surveyed:
        return mean if mean.any() else np.array([0.0, -1.0, 0.0])
    if mean[2] > _TILT:
        return np.array([0.0, 0.0, 1.0])
    axis = int(np.abs(mean).argmax())
    return np.eye(3)[axis] * np.copysign(1.0, mean[axis])


def _away(poses: StampedPoses, points: np.ndarray, up: np.ndarray) -> np.ndarray:
    """[3] unit, horizontal: where the cameras look, or across a path longer than its scene."""
    flat = np.eye(3) - np.outer(up, up)
    positions = poses.T_world_cam[:, :3, 3] @ flat
    along = np.linalg.svd(positions - positions.mean(0), full_matrices=False)[2][0] @ flat
    look = poses.T_world_cam[:, :3, 2].mean(0) @ flat
    if np.linalg.norm(look) < _STEADY_LOOK or \
            _extent(positions) > _LONG_PATH * _extent(points @ flat):
        look = np.cross(up, along)
    if np.linalg.norm(look) < 1e-6:     # a single camera that looks straight up or down
        look = flat[int(np.diag(flat).argmax())]
    return look / np.linalg.norm(look)


def _extent(points: np.ndarray) -> float:
    """The largest side of the box around nearly all points [N,3]."""
    if not len(points):
        return 0.0
    low, high = np.percentile(points, (2, 98), axis=0)
    return float((high - low).max())
