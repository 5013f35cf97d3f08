"""The camera's rigid pose from points and pixels."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from aim_slam_ros.geometry import camera, sim3
from aim_slam_ros.registration.rigid import solve_rigid, solve_rigid_from_scratch

K = camera.intrinsics(400.0, 410.0, 259.0, 190.0)
TRUTH = sim3.exp(torch.tensor([0.2, -0.1, 0.3, 0.1, -0.2, 0.05, 0.0], dtype=torch.float64))
NEAR = sim3.exp(torch.tensor([0.1, 0.1, -0.1, 0.05, 0.1, -0.05, 0.0], dtype=torch.float64))


def _scene(count: int = 400, sigma_px: float = 0.0, seed: int = 0) -> tuple[Tensor, np.ndarray]:
    """Points [N,3] in the reference frame and where the camera at TRUTH sees them."""
    rng = torch.Generator().manual_seed(seed)
    uv = torch.rand(count, 2, generator=rng, dtype=torch.float64) * torch.tensor([518.0, 392.0])
    depth = 1.0 + 3.0 * torch.rand(count, 1, generator=rng, dtype=torch.float64)
    rays = torch.cat([(uv - K[:2, 2]) / K.diagonal()[:2], torch.ones(count, 1)], 1)
    points = sim3.transform(sim3.inverse(TRUTH), rays * depth)
    noise = sigma_px * torch.randn(uv.shape, generator=rng, dtype=torch.float64)
    return points, (uv + noise).numpy()


def _error(T: Tensor) -> tuple[float, float]:
    """Rotation [deg] and camera position [of a depth of 1 to 4]."""
    return (math.degrees(sim3.angle_rad(T, TRUTH)),
            float((sim3.inverse(T) - sim3.inverse(TRUTH))[:3, 3].norm()))


def test_perfect_matches_give_the_pose_from_far_away() -> None:
    points, uv = _scene()
    got = solve_rigid(points.numpy(), uv, K, NEAR @ TRUTH, iterations=30)
    rotation, position = _error(got.T_cam_ref)
    assert rotation < 1e-3 and position < 1e-4
    assert got.inliers.all() and got.kappa < 1e-4
    assert float(sim3.scale_of(got.T_cam_ref)) == pytest.approx(1.0, abs=1e-9)


def test_the_guess_may_carry_a_scale() -> None:
    points, uv = _scene()
    got = solve_rigid(points.numpy(), uv, K, sim3.with_scale(TRUTH, 3.0))
    assert float(sim3.scale_of(got.T_cam_ref)) == pytest.approx(1.0, abs=1e-9)
    assert _error(got.T_cam_ref)[0] < 1e-3


@pytest.mark.parametrize('sigma_px', [0.5, 2.0])
def test_kappa_is_one_for_an_honest_sigma(sigma_px: float) -> None:
    points, uv = _scene(2000, sigma_px)
    got = solve_rigid(points.numpy(), uv, K, TRUTH, sigma_px=sigma_px)
    # residuals beyond 3 sigma are no inliers: 1.1 % of the points, which held 6 % of the sum
    assert got.kappa == pytest.approx(0.94, abs=0.06)
    assert solve_rigid(points.numpy(), uv, K, TRUTH, sigma_px=2 * sigma_px).kappa < 0.3


def test_a_third_of_outliers_does_not_matter() -> None:
    points, uv = _scene(600, 0.5)
    uv[:200] = np.random.default_rng(1).uniform(0, 390, (200, 2))
    got = solve_rigid(points.numpy(), uv, K, TRUTH @ sim3.exp(0.2 * sim3.log(NEAR)),
                      sigma_px=0.5)
    rotation, position = _error(got.T_cam_ref)
    assert rotation < 0.1 and position < 0.01
    assert got.inliers[200:].mean() > 0.95 and got.inliers[:200].mean() < 0.05


def test_wrong_depths_are_forgiven_where_they_are_told() -> None:
    """A depth error moves a point along its image of the old ray: only across it is it sure."""
    points, uv = _scene(400, 0.3)
    sigma = np.full(400, 0.02)
    sigma[:250] = 0.4
    rng = np.random.default_rng(2)
    wrong = points.numpy() * np.exp(sigma * rng.standard_normal(400))[:, None]
    spread = wrong * sigma[:, None]
    told = solve_rigid(wrong, uv, K, TRUTH, spread, sigma_px=0.3)
    untold = solve_rigid(wrong, uv, K, TRUTH, None, sigma_px=0.3)
    assert _error(told.T_cam_ref)[1] < 0.02
    assert _error(told.T_cam_ref)[1] < 0.7 * _error(untold.T_cam_ref)[1]
    assert told.inliers.mean() > 0.9 > 0.3 > untold.inliers.mean()
    assert 0.6 < told.kappa < 1.3


def test_turning_away_is_no_solution() -> None:
    """Points behind the camera cost a constant."""
    points, uv = _scene()
    X = points.numpy().copy()
    X[:40] -= 20.0 * TRUTH[2, :3].numpy()     # behind the true camera: they can never be seen
    got = solve_rigid(X, uv, K, TRUTH)
    assert _error(got.T_cam_ref)[0] < 0.1 and not got.inliers[:40].any()
    back = sim3.from_parts(1.0, torch.diag(torch.tensor([-1.0, 1.0, -1.0])), torch.zeros(3))
    away = solve_rigid(points.numpy(), uv, K, back @ TRUTH)
    assert torch.isfinite(away.T_cam_ref).all() and not away.inliers.any()
    assert away.kappa == math.inf


def test_information_is_that_of_the_residuals() -> None:
    """Against automatic differentiation of the projection, by a left perturbation."""
    points, uv = _scene(50)
    got = solve_rigid(points.numpy(), uv, K, TRUTH, sigma_px=0.7)

    def residual(xi: Tensor) -> Tensor:
        # First order of exp is exact for a derivative at 0.
        step = torch.zeros(4, 4, dtype=xi.dtype)
        step[:3, :3], step[:3, 3] = sim3.hat(xi[3:]), xi[:3]
        T = got.T_cam_ref + step @ got.T_cam_ref
        return camera.project(sim3.transform(T, points), K).reshape(-1) / 0.7

    J = torch.autograd.functional.jacobian(residual, torch.zeros(6, dtype=torch.float64))
    assert np.allclose(got.information, (J.T @ J).numpy(), rtol=1e-4, atol=1e-4 * float(J.max()))


def test_from_scratch_needs_no_guess() -> None:
    points, uv = _scene(200, 0.5)
    uv[:80] = np.random.default_rng(1).uniform(0, 390, (80, 2))
    got = solve_rigid_from_scratch(points.numpy(), uv, K)
    assert got is not None
    rotation, position = _error(got)
    assert rotation < 1.0 and position < 0.05    # a start for solve_rigid
    again = solve_rigid_from_scratch(points.numpy(), uv, K)
    assert again is not None and torch.equal(again, got)


def test_from_scratch_finds_nothing_in_too_little() -> None:
    points, uv = _scene(5)
    assert solve_rigid_from_scratch(points.numpy(), uv, K) is None
    points, _ = _scene(40)
    uv = np.random.default_rng(3).uniform(0, 390, (40, 2))
    found = solve_rigid_from_scratch(points.numpy(), uv, K, threshold_px=0.5)
    assert found is None or torch.isfinite(found).all()
