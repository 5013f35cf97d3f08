"""Robust rotation between bearings, and the parallax beyond it."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from aim_slam_ros.geometry import camera, rotation, sim3

K = camera.intrinsics(400.0, 410.0, 259.0, 190.0)


def _turn(*axis_angle: float) -> Tensor:
    return sim3.exp(torch.tensor([0.0, 0.0, 0.0, *axis_angle, 0.0], dtype=torch.float64))[:3, :3]


def _points(count: int = 300) -> Tensor:
    """[N,3], in front of the camera."""
    rng = torch.Generator().manual_seed(0)
    uv = torch.rand(count, 2, generator=rng, dtype=torch.float64) * 500
    return rotation.unit_rays(uv, K) * (1.0 + 4.0 * torch.rand(count, 1, generator=rng))


def _rays(points: Tensor) -> Tensor:
    return points / points.norm(dim=1, keepdim=True)


def _angle_deg(R: Tensor, truth: Tensor) -> float:
    cosine = (float((R.T @ truth).trace()) - 1.0) / 2.0
    return math.degrees(math.acos(max(-1.0, min(1.0, cosine))))


def test_unit_rays_project_to_their_pixels() -> None:
    uv = torch.tensor([[259.0, 190.0], [0.0, 0.0], [517.3, 388.1]])
    rays = rotation.unit_rays(uv, K)
    assert torch.allclose(rays.norm(dim=1), torch.ones(3, dtype=torch.float64))
    assert torch.allclose(camera.project(rays, K), uv.double())
    assert torch.equal(rays[0], torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))


def test_a_rotation_is_found_and_leaves_no_parallax() -> None:
    a, truth = _rays(_points()), _turn(0.2, -0.4, 0.1)
    b = a @ truth.T
    got = rotation.fit_rotation(a, b)
    assert _angle_deg(got, truth) < 1e-4
    assert rotation.parallax_px(a, b, got, 400.0) < 1e-6


def test_a_third_of_outliers_does_not_matter() -> None:
    a, truth = _rays(_points()), _turn(-0.1, 0.2, 0.3)
    b = a @ truth.T
    b[:100] = a[:100]       # what turns with the camera
    b += 1e-3 * torch.randn(b.shape, generator=torch.Generator().manual_seed(2))
    # 1 mrad of noise on 200 rays gives some hundredths of a degree
    assert _angle_deg(rotation.fit_rotation(a, b), truth) < 0.05


def test_it_is_never_a_reflection() -> None:
    """Bearings in one plane leave the sign of the third axis open."""
    a = torch.tensor([[math.sin(t), 0.0, math.cos(t)] for t in (-0.4, -0.1, 0.2, 0.5)],
                     dtype=torch.float64)
    truth = _turn(0.0, 0.3, 0.0)
    got = rotation.fit_rotation(a, a @ truth.T)
    assert float(torch.linalg.det(got)) == pytest.approx(1.0)
    assert _angle_deg(got, truth) < 1e-3


def test_a_translation_leaves_its_parallax() -> None:
    points = _points()
    truth = _turn(0.05, 0.1, -0.02)

    def parallax(baseline: float) -> float:
        moved = points @ truth.T + torch.tensor([baseline, 0.0, 0.0], dtype=torch.float64)
        a, b = _rays(points), _rays(moved)
        return rotation.parallax_px(a, b, rotation.fit_rotation(a, b), 400.0)

    # depths 1 to 5: a baseline of .1 moves the points by 8 to 40 px; a rotation takes most of it
    assert 2.0 < parallax(0.1) < 20.0
    assert parallax(0.2) == pytest.approx(2.0 * parallax(0.1), rel=0.25)
