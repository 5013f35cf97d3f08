"""Simulated predictions from recorded depth and ground truth (TUM fr1_xyz), where it is there."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from aim_slam_ros.geometry import camera, sim3

SEQUENCE = Path(__file__).resolve().parents[2] / 'shared/data/tum_fr1_xyz'
HEIGHT, WIDTH = 196, 259


@dataclass(frozen=True)
class DepthView:
    """depth: [H,W] float64 in metres, nan where there is none; T_world_cam: rigid [4,4]."""

    depth: Tensor
    T_world_cam: Tensor


def views(indices: list[int]) -> list[DepthView]:
    """The recorded depth frames with these numbers (5 per second), resized without blending."""
    lines = (SEQUENCE / 'associations.txt').read_text().splitlines()
    truth = np.loadtxt(SEQUENCE / 'groundtruth.txt')
    return [_view(lines[k].split(), truth) for k in indices]


def intrinsics() -> Tensor:
    text = dict(line.split(' = ') for line in (SEQUENCE / 'camera.txt').read_text().splitlines()
                if ' = ' in line and not line.startswith('#'))
    K = camera.intrinsics(*(float(text[name]) for name in ('fx', 'fy', 'cx', 'cy')))
    return camera.scaled(K, WIDTH / 640, HEIGHT / 480)


def _view(names: list[str], truth: np.ndarray) -> DepthView:
    raw = cv2.imread(str(SEQUENCE / names[3]), cv2.IMREAD_UNCHANGED)
    raw = cv2.resize(raw, (WIDTH, HEIGHT), interpolation=cv2.INTER_NEAREST)
    depth = torch.from_numpy(raw.astype(np.float64)) / 5000.0
    row = truth[np.abs(truth[:, 0] - float(names[2])).argmin()]
    R = sim3.rotation_from_quaternion(torch.from_numpy(row[4:8]))
    return DepthView(torch.where(depth > 0, depth, torch.nan),
                     sim3.from_parts(1.0, R, torch.from_numpy(row[1:4])))
