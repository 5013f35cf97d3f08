"""Ray matching, and every hand-written Jacobian against automatic differentiation."""

from __future__ import annotations

from typing import Callable

import box_room
import pytest
import torch
from torch import Tensor

from aim_slam_ros.geometry import camera, rays, sim3


def _points(count: int = 50) -> Tensor:
    """[N,3] float64 in front of the camera."""
    rng = torch.Generator().manual_seed(3)
    xy = torch.randn(count, 2, generator=rng, dtype=torch.float64)
    z = 1.0 + 3.0 * torch.rand(count, 1, generator=rng, dtype=torch.float64)
    return torch.cat([xy, z], -1)


def _by_autodiff(function: Callable[[Tensor], Tensor], points: Tensor) -> Tensor:
    """d function(exp(xi) X) / d xi at 0, [N,...,7]."""
    def moved(xi: Tensor, X: Tensor) -> Tensor:
        zero = torch.zeros(1, dtype=xi.dtype)
        wx, wy, wz = xi[3:6].unbind()
        hat = torch.stack([zero[0], -wz, wy, wz, zero[0], -wx, -wy, wx, zero[0]]).reshape(3, 3)
        A = torch.linalg.matrix_exp(torch.cat([
            torch.cat([hat + xi[6] * torch.eye(3, dtype=xi.dtype), xi[:3, None]], 1),
            torch.zeros(1, 4, dtype=xi.dtype)]))
        return function(A[:3, :3] @ X + A[:3, 3])
    zero = torch.zeros(7, dtype=torch.float64)
    return torch.stack([torch.func.jacfwd(moved)(zero, X) for X in points])


K = camera.intrinsics(500.0, 480.0, 259.0, 196.0)


@pytest.mark.parametrize('function, jacobian', [
    (lambda X: X, rays.point_jacobian),
    (lambda X: X / X.norm(), rays.ray_jacobian),
    (lambda X: X.norm().log(), rays.log_distance_jacobian),
    (lambda X: X[:2] / X[2] * torch.stack([K[0, 0], K[1, 1]]),
     lambda X: rays.pixel_jacobian(X, K)),
], ids=['point', 'ray', 'log_distance', 'projection'])
def test_jacobians_agree_with_autodiff(function: Callable[[Tensor], Tensor],
                                       jacobian: Callable[[Tensor], Tensor]) -> None:
    points = _points()
    torch.testing.assert_close(jacobian(points), _by_autodiff(function, points),
                               rtol=1e-9, atol=1e-9)


def test_ray_derivative_agrees_with_autodiff() -> None:
    X = _points(1)[0]
    expected = torch.func.jacfwd(lambda p: p / p.norm())(X)
    torch.testing.assert_close(rays.ray_derivative(X[None])[0], expected, rtol=1e-12, atol=1e-12)


def test_closed_form_normal_equations_equal_those_of_the_jacobians() -> None:
    rng = torch.Generator().manual_seed(1)
    X = _points()
    m = rays.rays_of(X + 0.1 * torch.randn(X.shape, generator=rng, dtype=torch.float64))
    e_ray = m - rays.rays_of(X)
    e_log = torch.randn(len(X), generator=rng, dtype=torch.float64)
    e_px = torch.randn(len(X), 2, generator=rng, dtype=torch.float64)
    w, v, p = torch.rand(3, len(X), generator=rng, dtype=torch.float64).unbind()
    J_ray, J_log, J_px = (rays.ray_jacobian(X), rays.log_distance_jacobian(X),
                          rays.pixel_jacobian(X, K))
    got = rays.ray_normal_equations(X.T[None], e_ray.T[None], e_log[None], w[None], v[None])
    H = torch.einsum('n,nki,nkj->ij', w, J_ray, J_ray) + (J_log * v[:, None]).T @ J_log
    g = torch.einsum('n,nki,nk->i', w, J_ray, e_ray) + J_log.T @ (v * e_log)
    torch.testing.assert_close(got.H[0], H, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(got.g[0], g, rtol=1e-9, atol=1e-9)
    focal = torch.stack([K[0, 0], K[1, 1]])[None]
    px = rays.pixel_normal_equations(X.T[None], e_px.T[None], p[None], focal)
    torch.testing.assert_close(px.H[0], torch.einsum('n,nki,nkj->ij', p, J_px, J_px),
                               rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(px.g[0], torch.einsum('n,nki,nk->i', p, J_px, e_px),
                               rtol=1e-9, atol=1e-9)


def test_only_log_distance_sees_scale() -> None:
    X = _points()
    assert float(rays.ray_jacobian(X)[..., 6].abs().max()) < 1e-12
    assert float(rays.pixel_jacobian(X, K)[..., 6].abs().max()) == 0.0
    assert float((rays.log_distance_jacobian(X)[..., 6] - 1).abs().max()) == 0.0


def test_sample_is_bilinear_and_nan_outside() -> None:
    grid = camera.pixel_grid(5, 7).double()   # an image that holds its own coordinates
    uv = torch.tensor([[0.0, 0.0], [6.0, 4.0], [2.25, 3.5], [-0.1, 2.0], [6.1, 1.0]]).double()
    got = rays.sample(grid, uv)
    torch.testing.assert_close(got[:3], uv[:3])
    assert bool(torch.isnan(got[3:]).all())


def test_matching_finds_the_true_pixel_within_a_pointmap_made_with_its_K() -> None:
    T_i, T_j = box_room.trajectory(2)
    points_i = camera.unproject(box_room.depth_of(T_i), box_room.K)
    points_j = camera.unproject(box_room.depth_of(T_j), box_room.K)
    X = sim3.transform(sim3.inverse(T_i) @ T_j, points_j).reshape(-1, 3)[::7]
    matches = rays.match_rays(points_i, X, box_room.K, iterations=0)
    true = camera.project(X, box_room.K)
    assert float(matches.valid.double().mean()) > 0.8
    torch.testing.assert_close(matches.uv_i[matches.valid], true[matches.valid])


def test_matching_searches_where_the_pointmap_left_its_pixels() -> None:
    """A fused pointmap, 1 % off in focal length: up to 1.3 px without search, .05 px with it."""
    K = box_room.K
    depth = box_room.depth_of(box_room.pose((0.0, 0.0, -1.2), (0.0, 0.0, 0.0)))
    fused = camera.unproject(depth, K @ torch.diag(torch.tensor([1.01, 1.01, 1.0]).double()))
    target = fused[20:-20:5, 20:-20:5].reshape(-1, 3)
    true = camera.pixel_grid(*depth.shape).double()[20:-20:5, 20:-20:5].reshape(-1, 2)
    without = rays.match_rays(fused, target, K, iterations=0)
    matches = rays.match_rays(fused, target, K)
    assert float((without.uv_i - true).norm(dim=-1).max()) > 1.0
    # the pillar's outline is a jump of depth, where the fixed point may settle on the other side
    error = (matches.uv_i - true)[matches.valid].norm(dim=-1)
    assert float(matches.valid.double().mean()) > 0.95
    assert float(error.quantile(0.95)) < 0.05


def test_points_behind_or_outside_do_not_match() -> None:
    points = camera.unproject(torch.full((20, 30), 2.0), camera.intrinsics(20, 20, 15, 10))
    X = torch.tensor([[0.0, 0.0, -1.0], [9.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
    got = rays.match_rays(points, X, camera.intrinsics(20, 20, 15, 10))
    assert got.valid.tolist() == [False, False, True]
    assert len(rays.match_rays(points, X[:0], camera.intrinsics(20, 20, 15, 10)).valid) == 0
