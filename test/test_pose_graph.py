"""The Sim(3) pose graph: GTSAM's convention, drift, false loops, pieces."""

from __future__ import annotations

import math
from dataclasses import dataclass

import gtsam
import numpy as np
import pytest
import torch
from torch import Tensor

from aim_slam_ros.geometry import sim3
from aim_slam_ros.loop_closure import pose_graph
from aim_slam_ros.loop_closure.pose_graph import PoseGraph, PoseGraphError
from aim_slam_ros.types import PoseEdge
from room_walk import ate

SIGMA = torch.tensor([0.02] * 3 + [0.005] * 3 + [0.01], dtype=torch.float64)


def random_pose(seed: int, size: float = 0.7) -> Tensor:
    rng = torch.Generator().manual_seed(seed)
    return sim3.exp(size * torch.randn(7, generator=rng, dtype=torch.float64))


@dataclass(frozen=True)
class Ring:
    """A drifting odometry once around a circle. truth: [N,4,4], each in its own unit."""

    graph: PoseGraph
    truth: Tensor

    def estimate(self) -> Tensor:
        return torch.stack(list(self.graph.poses().values()))

    def error(self) -> float:
        return ate(self.estimate(), self.truth)

    def close(self, older: int, newer: int, sigma: Tensor = SIGMA) -> None:
        T = sim3.inverse(self.truth[older]) @ self.truth[newer]
        self.graph.add_edge(PoseEdge(older, newer, T, sigma), robust=True)

    def close_falsely(self, older: int, newer: int) -> None:
        """Two places on opposite sides of the ring, said to be the same."""
        self.graph.add_edge(PoseEdge(older, newer, random_pose(3, 0.1), SIGMA), robust=True)


def ring(count: int = 60, scale_drift: float = 0.1, rotation_drift: float = 0.05,
         sigma: Tensor = SIGMA) -> Ring:
    """scale_drift: relative; rotation_drift: rad, both over the whole ring of radius 5."""
    truth = _circle(count)
    bias = torch.tensor([0, 0, 0, rotation_drift, 0.5 * rotation_drift, 0,
                         math.log(1 + scale_drift)], dtype=torch.float64) / count
    rng = torch.Generator().manual_seed(1)
    graph = PoseGraph(cauchy_width=3.0)
    graph.add_keyframe(0, truth[0])
    for i in range(1, count):
        noise = 0.1 * sigma * torch.randn(7, generator=rng, dtype=torch.float64)
        T = sim3.exp(bias + noise) @ sim3.inverse(truth[i - 1]) @ truth[i]
        graph.add_keyframe(i, graph.pose(i - 1) @ T)
        graph.add_edge(PoseEdge(i - 1, i, T, sigma), robust=False)
    return Ring(graph, truth)


def _circle(count: int) -> Tensor:
    angle = torch.linspace(0, 2 * math.pi, count, dtype=torch.float64)
    zero = torch.zeros_like(angle)
    R = sim3.exp(torch.stack([zero, zero, zero, zero, angle, zero, zero], 1))[:, :3, :3]
    centre = 5.0 * torch.stack([angle.cos(), zero, -angle.sin()], 1)
    unit = torch.exp(0.2 * torch.randn(count, generator=torch.Generator().manual_seed(0)))
    unit[0] = 1.0
    return sim3.from_parts(unit, R, centre)


def test_poses_round_trip_and_act_the_same() -> None:
    T = random_pose(0)
    S = pose_graph.to_gtsam(T)
    assert torch.allclose(pose_graph.from_gtsam(S), T, atol=1e-12)
    point = np.array([0.3, -1.0, 2.0])
    assert S.transformFrom(point) == pytest.approx(
        sim3.transform(T, torch.from_numpy(point)).numpy())


def test_products_and_inverses_mean_the_same_on_both_sides() -> None:
    a, b = random_pose(1), random_pose(2)
    product = pose_graph.to_gtsam(a).inverse().compose(pose_graph.to_gtsam(b))
    assert torch.allclose(pose_graph.from_gtsam(product), sim3.inverse(a) @ b, atol=1e-12)


def test_a_left_perturbation_costs_what_its_sigma_says() -> None:
    # The factor's error at exp(xi) T must be half the squared length of xi / sigma, for whatever
    # T: this checks the order, the side and the adjoint at once.
    T = random_pose(4)
    sigma = torch.tensor([0.1, 0.2, 0.3, 0.01, 0.02, 0.03, 0.05], dtype=torch.float64)
    noise = gtsam.noiseModel.Gaussian.Covariance(pose_graph.to_gtsam_covariance(T, sigma))
    factor = gtsam.BetweenFactorSimilarity3(0, 1, pose_graph.to_gtsam(T), noise)
    world = random_pose(5)
    for k in range(7):
        xi = torch.zeros(7, dtype=torch.float64)
        xi[k] = 2.0 * sigma[k]
        values = gtsam.Values()
        values.insert(0, pose_graph.to_gtsam(world))
        values.insert(1, pose_graph.to_gtsam(world @ sim3.exp(xi) @ T))
        assert factor.error(values) == pytest.approx(2.0, rel=1e-6)


def test_a_loop_edge_removes_the_drift() -> None:
    drifted = ring()
    before = drifted.error()
    drifted.close(0, 59)
    drifted.graph.optimise()
    assert drifted.error() < 0.4 * before
    # The drift is systematic, so what it did to the shape is known once the loop is.
    scales = sim3.scale_of(drifted.estimate()) / sim3.scale_of(drifted.truth)
    assert float(scales[-1]) == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize('true_loops', [1, 3])
def test_a_false_loop_does_not_ruin_it(true_loops: int) -> None:
    drifted = ring()
    before = drifted.error()
    for k in range(true_loops):
        drifted.close(2 * k, 59 - 2 * k)
    drifted.close_falsely(15, 45)
    drifted.graph.optimise()
    assert drifted.error() < 0.4 * before


def test_a_false_loop_alone_leaves_the_odometry() -> None:
    drifted = ring()
    before = drifted.estimate()
    drifted.close_falsely(15, 45)
    drifted.graph.optimise()
    # It pulls by a tail of its Cauchy loss; the ring is 10 across.
    assert float((drifted.estimate() - before)[:, :3, 3].norm(dim=1).max()) < 0.3


def test_large_drift_with_confident_edges_is_still_recognised() -> None:
    # 30 % against .3 % per edge: without annealing the true loop would pass for a false one.
    drifted = ring(scale_drift=0.3, sigma=0.3 * SIGMA)
    before = drifted.error()
    drifted.close(0, 59, 0.3 * SIGMA)
    drifted.graph.optimise()
    assert drifted.error() < 0.1 * before


def test_without_loops_nothing_moves() -> None:
    drifted = ring(count=10)
    before = drifted.estimate()
    drifted.graph.optimise()
    assert torch.allclose(drifted.estimate(), before, atol=1e-9)


def test_pieces_stay_solvable_and_where_they_were() -> None:
    graph = ring(count=5).graph
    graph.add_keyframe(100, random_pose(6))
    graph.add_keyframe(101, random_pose(7))
    graph.add_edge(PoseEdge(100, 101, random_pose(8), SIGMA), robust=False)
    poses = graph.optimise()
    assert torch.allclose(poses[100], random_pose(6), atol=1e-6)
    assert torch.allclose(poses[101], random_pose(6) @ random_pose(8), atol=1e-6)


@pytest.mark.parametrize('backwards', [False, True])
def test_a_loop_carries_the_newer_piece_into_the_world_of_the_older(backwards: bool) -> None:
    graph = PoseGraph()
    T_world = [random_pose(k, 0.3) for k in range(4)]
    T_away = random_pose(9)
    for k, T in enumerate(T_world):
        graph.add_keyframe(k, T if k < 2 else T_away @ T)
    for a, b in ((0, 1), (2, 3)):
        graph.add_edge(PoseEdge(a, b, sim3.inverse(T_world[a]) @ T_world[b], SIGMA), robust=False)
    a, b = (3, 1) if backwards else (1, 3)
    graph.add_edge(PoseEdge(a, b, sim3.inverse(T_world[a]) @ T_world[b], SIGMA), robust=True)
    poses = graph.optimise()
    assert torch.allclose(torch.stack(list(poses.values())), torch.stack(T_world), atol=1e-6)


def test_neighbourhoods() -> None:
    graph = ring(count=20).graph
    graph.add_keyframe(20, sim3.identity())     # a piece of its own
    assert graph.within(10, 2) == {8, 9, 10, 11, 12}
    assert graph.neighbours(10) == (9, 11)
    assert graph.neighbourhood(19, hops=1, gap=5) == {15, 16, 17, 18, 19}
    assert graph.neighbourhood(20, hops=1, gap=5) == {20}
    assert graph.neighbourhood(10, hops=1, gap=3) == {8, 9, 10, 11, 12}, 'one that came late'


def test_a_new_keyframe_is_chained_to_the_mean_of_its_edges() -> None:
    graph = ring(count=3, scale_drift=0.0, rotation_drift=0.0).graph
    T_new = random_pose(2)
    edges = [PoseEdge(k, 7, sim3.inverse(graph.pose(k)) @ T_new, SIGMA) for k in (1, 2)]
    chained = graph.chained(7, edges)
    assert chained is not None and torch.allclose(chained, T_new, atol=1e-9)
    assert graph.chained(8, edges) is None


def test_unusable_input_is_refused_with_the_reason() -> None:
    graph = ring(count=3).graph
    with pytest.raises(PoseGraphError, match='never be reused'):
        graph.add_keyframe(1, sim3.identity())
    with pytest.raises(PoseGraphError, match='not a Sim'):
        graph.add_keyframe(9, torch.full((4, 4), math.nan, dtype=torch.float64))
    with pytest.raises(PoseGraphError, match='unknown: .9.'):
        graph.add_edge(PoseEdge(0, 9, sim3.identity(), SIGMA), robust=False)
    with pytest.raises(PoseGraphError, match='positive'):
        graph.add_edge(PoseEdge(0, 1, sim3.identity(), 0.0 * SIGMA), robust=False)
