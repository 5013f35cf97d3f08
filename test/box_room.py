"""A room of known geometry, seen by the analytic intersection of pixel rays with its walls."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from aim_slam_ros.geometry import camera, sim3
from aim_slam_ros.types import Frame, FrameEncoding, Keyframe, WindowPrediction

HALF_SIZE = torch.tensor([2.0, 1.4, 2.5], dtype=torch.float64)
HEIGHT, WIDTH = 196, 260
K = camera.intrinsics_from_fov(WIDTH, HEIGHT, 65.0)


def pose(t: tuple[float, float, float], rotation: tuple[float, float, float]) -> Tensor:
    """Rigid T_world_cam [4,4] from a position and an axis-angle vector [rad]."""
    xi = torch.tensor([0.0, 0.0, 0.0, *rotation, 0.0], dtype=torch.float64)
    return sim3.from_parts(1.0, sim3.exp(xi)[:3, :3], torch.tensor(t, dtype=torch.float64))


def depth_of(T_world_cam: Tensor, K: Tensor = K, height: int = HEIGHT,
             width: int = WIDTH) -> Tensor:
    """Depth [H,W] float64 of a room with a pillar in it, from inside the room."""
    rays = camera.unproject(torch.ones(height, width, dtype=torch.float64), K)
    directions = rays @ T_world_cam[:3, :3].T
    origin = T_world_cam[:3, 3]
    walls = (torch.where(directions < 0, -HALF_SIZE, HALF_SIZE) - origin) / directions
    depth = walls.amin(-1)
    # A vertical pillar of radius .2 near the far wall: an occluder.
    centre = torch.tensor([0.3, 1.2], dtype=torch.float64)
    o, d = origin[[0, 2]] - centre, directions[..., [0, 2]]
    a, b, c = (d * d).sum(-1), (d * o).sum(-1), (o * o).sum() - 0.04
    root = (b * b - a * c).clamp_min(0.0).sqrt()
    hit = (-b - root) / a
    return torch.where((b * b > a * c) & (hit > 0) & (hit < depth), hit, depth)


def trajectory(views: int) -> list[Tensor]:
    """Poses with parallax and overlap, oldest first."""
    return [pose((0.12 * k - 0.2, 0.04 * k, -1.2 + 0.03 * k),
                 (0.02 * k, 0.05 * k - 0.08, 0.01 * k)) for k in range(views)]


def keyframe(keyframe_id: int, T_world_cam: Tensor, unit: float = 1.0, depth: Tensor | None = None,
             T_guess: Tensor | None = None, observations: int = 1) -> Keyframe:
    """A keyframe whose points are in units of ``unit`` metres, so that T_world_kf carries it."""
    depth = depth_of(T_world_cam) if depth is None else depth
    points = camera.unproject((depth / unit).float(), K)
    frame = Frame(1000 * (keyframe_id + 1), np.zeros((*depth.shape, 3), np.uint8))
    scale = sim3.from_parts(unit, torch.eye(3), torch.zeros(3))
    T = (T_world_cam if T_guess is None else T_guess) @ scale
    return Keyframe(keyframe_id, 0, FrameEncoding(frame, torch.ones(1), None), K, points,
                    torch.full(tuple(depth.shape), 5.0), T, observations)


def prediction(T_world_cams: list[Tensor], unit: float, noise: float = 0.0,
               pose_noise: tuple[float, float] = (0.0, 0.0), seed: int = 0,
               depths: list[Tensor] | None = None) -> WindowPrediction:
    """What a model would say, current view first, in units of ``unit`` metres.

    noise: relative, per pixel. pose_noise: rotation [rad] and translation [m], RMS per view.
    """
    rng = torch.Generator().manual_seed(seed)
    depth = torch.stack([depth_of(T) for T in T_world_cams] if depths is None else depths)
    depth = depth * (1 + noise * torch.randn(depth.shape, generator=rng, dtype=torch.float64))
    xi = torch.randn(len(T_world_cams), 7, generator=rng, dtype=torch.float64) / 3 ** 0.5
    xi = xi * torch.tensor([pose_noise[1]] * 3 + [pose_noise[0]] * 3 + [0.0])
    xi[0] = 0.0
    T_first = sim3.inverse(T_world_cams[0]) @ torch.stack(T_world_cams) @ sim3.exp(xi)
    T_first[:, :3, 3] /= unit
    return WindowPrediction((depth / unit).float(), torch.full(depth.shape, 5.0),
                            K.expand(len(depth), 3, 3), T_first)
