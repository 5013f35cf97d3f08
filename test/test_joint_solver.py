"""The joint Sim(3) solve by itself: its linearisation, what it recovers, and how sure it is."""

from __future__ import annotations

from dataclasses import replace

import box_room
import pytest
import torch
from scipy.stats import chi2
from torch import Tensor

from aim_slam_ros.config import JointTrackingConfig
from aim_slam_ros.frontend import joint_solver
from aim_slam_ros.frontend.joint_residuals import PairMatches
from aim_slam_ros.geometry import camera, rays, sim3

CONFIG = JointTrackingConfig()
RESIDUALS = ('ray', 'projection', 'hybrid')
PIXEL_RAD = 1.0 / float(box_room.K[0, 0])
TRUTH = sim3.exp(torch.tensor([0.2, -0.1, 0.15, 0.06, -0.1, 0.05, 0.3], dtype=torch.float64))
NEAR = sim3.exp(torch.tensor([0.1, 0.1, -0.1, 0.05, 0.04, -0.05, -0.1], dtype=torch.float64))


def _pair(points_j: Tensor, points_i: Tensor, i: int = 0, j: int = 1) -> PairMatches:
    """Equally confident matches [N,3] of a pair without a past."""
    return PairMatches(i, j, points_j, points_i, torch.ones(len(points_j)).to(points_j),
                       box_room.K, 325.0, 3.0, sim3.identity(), None)


def _points(step: int = 8) -> Tensor:
    """[N,3] float64 of the room."""
    depth = box_room.depth_of(box_room.trajectory(1)[0])
    return camera.unproject(depth, box_room.K)[::step, ::step].reshape(-1, 3)


def _measured(X: Tensor, seed: int) -> Tensor:
    """Points X [N,3] as a camera sees them with 1 px of noise, and with noisy distances."""
    rng = torch.Generator().manual_seed(seed)
    uv = camera.project(X, box_room.K)
    uv = uv + torch.randn(uv.shape, generator=rng, dtype=X.dtype)
    ray = torch.cat([(uv - box_room.K[:2, 2]) / box_room.K.diagonal()[:2],
                     torch.ones(len(X), 1).double()], 1)
    log_d = CONFIG.sigma_log_distance * torch.randn(len(X), 1, generator=rng, dtype=X.dtype)
    return rays.rays_of(ray) * X.norm(dim=-1, keepdim=True) * log_d.exp()


@pytest.mark.parametrize('residual', RESIDUALS)
def test_a_known_similarity_is_recovered_from_clean_data(residual: str) -> None:
    """Scale included, in float32 data."""
    X = _points()
    pair = _pair(X.float(), sim3.transform(TRUTH, X).float())
    got = joint_solver.solve((NEAR @ TRUTH)[None], (pair,), replace(CONFIG, residual=residual))
    torch.testing.assert_close(got.links[0], TRUTH, rtol=0.0, atol=1e-4)
    assert got.kappa < 1e-6


@pytest.mark.parametrize('residual, huber', [('projection', 100.0), ('projection', CONFIG.huber),
                                             ('ray', 100.0)])
def test_its_information_is_honest_about_one_pixel_of_noise(residual: str, huber: float) -> None:
    """The mean normalised estimation error squared of 120 seeds is that of 7 degrees of freedom.

    Rays have one sigma, a pixel is the same angle only in the middle of the image.
    """
    seeds = 120
    config = replace(CONFIG, residual=residual, huber=huber, sigma_pixel=1.0,
                     sigma_ray=PIXEL_RAD)
    X = _points()
    if residual == 'ray':
        X = X[(X[:, :2].norm(dim=-1) < 0.2 * X[:, 2])]
    seen = sim3.transform(TRUTH, X)
    X, seen = X[seen[:, 2] > 0.5], seen[seen[:, 2] > 0.5]
    squared = []
    for seed in range(seeds):
        pair = _pair(X.float(), _measured(seen, seed).float())
        got = joint_solver.solve(TRUTH[None], (pair,), config)
        error = sim3.log(got.links[0] @ sim3.inverse(TRUTH))
        squared.append(float(error @ got.information @ error))
    low, high = (float(chi2.ppf(p, 7 * seeds)) / seeds for p in (0.025, 0.975))
    assert low < sum(squared) / seeds < high


def test_hybrid_does_not_count_its_data_twice() -> None:
    X = _points()
    pair = _pair(X.float(), _measured(sim3.transform(TRUTH, X), 0).float())
    by_ray, hybrid = (joint_solver.solve(TRUTH[None], (pair,), replace(CONFIG, residual=r))
                      for r in ('ray', 'hybrid'))
    # linearised at two solutions that differ by the noise
    torch.testing.assert_close(hybrid.information.diagonal(), by_ray.information.diagonal(),
                               rtol=0.03, atol=0.0)


@pytest.mark.parametrize('residual', RESIDUALS)
def test_composed_pairs_are_linearised_as_automatic_differentiation_does(residual: str) -> None:
    """Three views; the pair (0, 2) sees the product of both links."""
    # sigmas so wide that Huber, linear from 100 on, is not met
    config = replace(CONFIG, residual=residual, huber=100.0, sigma_ray=0.1, sigma_pixel=100.0)
    X, links = _points(24), torch.stack([TRUTH, sim3.inverse(NEAR)])
    T = {(0, 1): links[0], (1, 2): links[1], (0, 2): links[0] @ links[1]}
    pairs = tuple(_pair(X, _measured(sim3.transform(T_i_j, X), seed), *ij)
                  for seed, (ij, T_i_j) in enumerate(T.items()))

    def residuals(delta: Tensor) -> Tensor:
        moved = [_moved(delta[:7], links[0]), _moved(delta[7:], links[1])]
        T_i_j = (moved[0], moved[1], moved[0] @ moved[1])
        return torch.cat([_whitened(pair, T, config) for pair, T in zip(pairs, T_i_j)])

    zero = torch.zeros(14, dtype=torch.float64)
    e, J = residuals(zero), torch.func.jacfwd(residuals)(zero)
    full = joint_solver.PairResiduals(pairs, config)
    memory = joint_solver._memory(pairs, full, config.residual)
    system = joint_solver._Descent(pairs, full, memory, residual, config)._system(links)
    torch.testing.assert_close(system.equations.H, J.T @ J, rtol=1e-8, atol=1e-6)
    torch.testing.assert_close(system.equations.g, -J.T @ e, rtol=1e-8, atol=1e-6)
    assert system.cost == pytest.approx(0.5 * float(e @ e), rel=1e-9)


def _moved(xi: Tensor, T: Tensor) -> Tensor:
    """exp(xi) T to first order, which is exact for a derivative at 0."""
    A = torch.cat([sim3.hat(xi[3:6]) + xi[6] * torch.eye(3).double(), xi[:3, None]], 1)
    return T + torch.cat([A, torch.zeros(1, 4).double()]) @ T


def _whitened(pair: PairMatches, T: Tensor, config: JointTrackingConfig) -> Tensor:
    """All residuals, measured minus predicted, one after the other."""
    X, seen = pair.points_j @ T[:3, :3].T + T[:3, 3], pair.points_i
    rows = [(seen.norm(dim=-1).log() - X.norm(dim=-1).log()) / config.sigma_log_distance]
    if config.residual != 'projection':
        rows.append(((rays.rays_of(seen) - rays.rays_of(X)) / config.sigma_ray).flatten())
    if config.residual != 'ray':
        focal = box_room.K.diagonal()[:2]
        uv = (seen[:, :2] / seen[:, 2:] - X[:, :2] / X[:, 2:]) * focal
        rows.append((uv / config.sigma_pixel).flatten())
    return torch.cat(rows)


def test_a_link_that_no_match_sees_is_no_unknown_of_kappa() -> None:
    """Four matches are 12 rows: 5 degrees of freedom beyond one link, none beyond two."""
    X = _points(48)[:4]
    unseen = _pair(X[:0].float(), X[:0].float(), 0, 1)
    seen = _pair(X.float(), _measured(sim3.transform(TRUTH, X), 0).float(), 1, 2)
    unseen = replace(unseen, observations=1.0)
    config = replace(CONFIG, sigma_ray=PIXEL_RAD, residual='ray')
    got = joint_solver.solve(torch.stack([sim3.identity(), TRUTH]), (unseen, seen), config)
    alone = joint_solver.solve(TRUTH[None], (replace(seen, i=0, j=1),), config)
    assert got.kappa == pytest.approx(alone.kappa, rel=1e-3) and 0.0 < got.kappa < 10.0
