"""Sim(3) and camera mathematics: group properties and conventions."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from aim_slam_ros.geometry import camera, sim3


def close(a: Tensor, b: Tensor) -> bool:
    """Up to the rounding of products of a few float64 matrices of order 1."""
    return torch.allclose(a, b, rtol=0.0, atol=1e-11)


def tangents(count: int = 50, size: float = 0.8, seed: int = 0) -> Tensor:
    """[N,7]; rotations stay below pi, where the logarithm is unique."""
    rng = torch.Generator().manual_seed(seed)
    return size * (2.0 * torch.rand(count, 7, generator=rng, dtype=torch.float64) - 1.0)


def test_log_undoes_exp() -> None:
    xi = tangents()
    assert close(sim3.log(sim3.exp(xi)), xi)


@pytest.mark.parametrize('size', [0.0, 1e-12, 1e-8, 1e-4])
def test_log_undoes_exp_near_the_identity(size: float) -> None:
    xi = tangents(size=size)
    assert torch.allclose(sim3.log(sim3.exp(xi)), xi, rtol=0.0, atol=1e-14)


@pytest.mark.parametrize('axis', [(1.0, 0, 0), (0, 1.0, 0), (0, 0, 1.0), (0.6, 0.0, 0.8)])
def test_exp_undoes_log_near_a_half_turn(axis: tuple[float, float, float]) -> None:
    omega = (math.pi - 1e-7) * torch.tensor(axis, dtype=torch.float64)
    xi = torch.cat([torch.tensor([1.0, -2.0, 0.5]), omega, torch.tensor([0.3])])
    T = sim3.exp(xi)
    # The trace is flat here: half of the digits of the angle are gone, none of the action.
    assert torch.allclose(sim3.exp(sim3.log(T)), T, rtol=0.0, atol=1e-9)


def test_the_tangent_is_translation_rotation_log_scale() -> None:
    only = torch.eye(7, dtype=torch.float64)
    assert torch.allclose(sim3.translation_of(sim3.exp(only[0])), only[0, :3])
    quarter = sim3.exp(math.pi / 2 * only[5])
    assert close(sim3.transform(quarter, only[0, :3]), only[1, :3])
    assert float(sim3.scale_of(sim3.exp(math.log(2.0) * only[6]))) == pytest.approx(2.0)


def test_inverse_and_parts() -> None:
    T = sim3.exp(tangents())
    assert close(T @ sim3.inverse(T), sim3.identity().expand_as(T))
    parts = sim3.from_parts(sim3.scale_of(T), sim3.rotation_of(T), sim3.translation_of(T))
    assert close(parts, T)
    R = sim3.rotation_of(T)
    assert close(R @ R.mT, torch.eye(3, dtype=torch.float64).expand_as(R))
    assert torch.allclose(sim3.scale_of(sim3.rigid_part(T)), torch.ones(len(T)).double())
    assert torch.allclose(sim3.scale_of(sim3.with_scale(T, 3.0)), torch.tensor(3.0).double())


def test_transform_acts_as_scale_rotation_translation_and_keeps_the_dtype() -> None:
    T = sim3.exp(tangents()[0])
    points = torch.randn(4, 5, 3)
    expected = (float(sim3.scale_of(T)) * points.double() @ sim3.rotation_of(T).T
                + sim3.translation_of(T))
    moved = sim3.transform(T, points)
    assert moved.dtype == torch.float32
    assert torch.allclose(moved.double(), expected, atol=1e-5)     # float32 points


def test_a_matrix_that_is_nearly_a_member_becomes_one() -> None:
    T = sim3.exp(tangents())
    nearly = T + 1e-6 * torch.randn(T.shape, generator=torch.Generator().manual_seed(0)).double()
    member = sim3.on_group(nearly)
    assert torch.allclose(member, nearly, rtol=0.0, atol=1e-4)      # scales up to some tens
    assert close(sim3.inverse(member) @ member, torch.eye(4).double().expand_as(T))
    assert close(sim3.on_group(T), T)


def test_adjoint_carries_a_perturbation_across() -> None:
    T, xi = sim3.exp(tangents(seed=1)), tangents(size=0.3, seed=2)
    carried = (sim3.adjoint(T) @ xi[..., None])[..., 0]
    assert close(T @ sim3.exp(xi) @ sim3.inverse(T), sim3.exp(carried))


def test_a_left_perturbation_moves_a_point_as_the_jacobians_say() -> None:
    T = sim3.exp(tangents()[3])
    point = torch.tensor([0.3, -0.4, 2.0], dtype=torch.float64)

    def moved(xi: Tensor) -> Tensor:
        # First order of exp is exact for a derivative at 0.
        A = torch.cat([sim3.hat(xi[3:6]) + xi[6] * torch.eye(3, dtype=torch.float64),
                       xi[:3, None]], 1)
        X = sim3.transform(T, point)
        return X + A[:, :3] @ X + A[:, 3]

    J = torch.func.jacfwd(moved)(torch.zeros(7, dtype=torch.float64))
    X = sim3.transform(T, point)
    analytic = torch.cat([torch.eye(3, dtype=torch.float64), -sim3.hat(X), X[:, None]], 1)
    assert close(J, analytic)
    step = 1e-6
    numeric = torch.stack([
        (sim3.transform(sim3.exp(step * e) @ T, point)
         - sim3.transform(sim3.exp(-step * e) @ T, point)) / (2 * step)
        for e in torch.eye(7, dtype=torch.float64)], 1)
    assert torch.allclose(numeric, analytic, rtol=0.0, atol=1e-8)   # step^2 and rounding / step


def test_quaternions_round_trip_at_every_pivot() -> None:
    R = sim3.rotation_of(sim3.exp(tangents(size=3.0)))
    half_turns = torch.diag_embed(torch.tensor(
        [[1.0, -1, -1], [-1, 1, -1], [-1, -1, 1], [1, 1, 1]], dtype=torch.float64))
    R = torch.cat([R, half_turns])
    q = sim3.quaternion_of(R)
    assert torch.allclose(q.norm(dim=-1), torch.ones(len(q)).double())
    assert bool((q[:, 3] >= 0).all())
    assert close(sim3.rotation_from_quaternion(q), R)
    assert close(sim3.rotation_from_quaternion(5.0 * q), R)


def test_the_quaternion_is_xyzw() -> None:
    quarter_about_z = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    half = math.sqrt(0.5)
    assert sim3.quaternion_of(quarter_about_z).tolist() == pytest.approx([0, 0, half, half])


def test_mean_does_not_depend_on_the_frame() -> None:
    T = sim3.exp(tangents(count=6, size=0.4))
    weights = torch.tensor([1.0, 2, 3, 1, 1, 0])
    moved = sim3.exp(tangents(seed=7)[0])
    assert torch.allclose(sim3.mean(moved @ T, weights), moved @ sim3.mean(T, weights),
                          rtol=0.0, atol=1e-9)     # the last step is below 1e-8


def test_mean_of_two_lies_halfway_and_zero_weights_do_not_count() -> None:
    a, b = sim3.exp(tangents(count=2))
    halfway = sim3.exp(0.5 * sim3.log(b @ sim3.inverse(a))) @ a
    assert torch.allclose(sim3.mean(torch.stack([a, b]), torch.ones(2)), halfway,
                          rtol=0.0, atol=1e-9)
    assert torch.allclose(sim3.mean(torch.stack([a, b]), torch.tensor([0.0, 2.0])), b)


def test_angle_ignores_the_scale() -> None:
    T = sim3.exp(torch.tensor([0, 0, 0, 0, 0.3, 0, 0.7], dtype=torch.float64))
    assert sim3.angle_rad(sim3.identity(), T) == pytest.approx(0.3)


def test_projection_undoes_unprojection() -> None:
    K = camera.intrinsics(200.0, 210.0, 30.0, 20.0)
    depth = 1.0 + torch.rand(2, 40, 60)
    points = camera.unproject(depth, K.expand(2, 3, 3))
    assert torch.allclose(points[..., 2], depth)
    grid = camera.pixel_grid(40, 60).expand(2, -1, -1, -1)
    assert torch.allclose(camera.project(points, K), grid, atol=1e-4)   # float32 below 100


def test_nothing_projects_from_behind() -> None:
    behind = torch.tensor([[0.1, 0.1, -1.0], [0.1, 0.1, 0.0]])
    uv = camera.project(behind, camera.intrinsics_from_fov(60, 40, 60.0))
    assert bool(uv.isnan().all())
    assert not bool(camera.inside(uv, 40, 60).any())


def test_inside_counts_pixel_centres() -> None:
    uv = torch.tensor([[0.0, 0.0], [59.0, 39.0], [59.5, 10.0], [-0.1, 10.0]])
    assert camera.inside(uv, 40, 60).tolist() == [True, True, False, False]


def test_scaled_intrinsics_see_the_same_ray() -> None:
    K = camera.intrinsics(500.0, 510.0, 319.5, 239.5)
    small = camera.scaled(K, 0.5, 0.25)
    point = torch.tensor([0.2, -0.1, 1.0], dtype=torch.float64)
    uv = (camera.project(point, K) + 0.5) * torch.tensor([0.5, 0.25]) - 0.5
    assert torch.allclose(camera.project(point, small), uv)


def test_field_of_view() -> None:
    K = camera.intrinsics_from_fov(100, 80, 90.0, aspect=1.1)
    assert float(K[0, 0]) == pytest.approx(50.0)
    assert float(K[1, 1]) == pytest.approx(55.0)
    assert K[:2, 2].tolist() == [50.0, 40.0]
