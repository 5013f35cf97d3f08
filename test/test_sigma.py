"""SIGMA: the gain's value, the ranking it leads to, and the logic of the activation."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Sequence

import box_room
import pytest
import torch
from torch import Tensor

from aim_slam_ros.config import SigmaConfig
from aim_slam_ros.frontend import sigma
from aim_slam_ros.frontend.voxel_index import (VoxelIndex, confident_points,
                                               relative_voxel_size)
from aim_slam_ros.geometry import camera, rays, sim3
from aim_slam_ros.types import Keyframe

CONFIG = SigmaConfig()
LAST = box_room.pose((0.0, 0.0, -1.2), (0.0, 0.0, 0.0))


def _last() -> Keyframe:
    return box_room.keyframe(9, LAST, unit=1.4)


def _seen_at(keyframe_id: int, x: float, unit: float = 1.0, turn: float = 0.0) -> Keyframe:
    return box_room.keyframe(keyframe_id, box_room.pose((x, 0.0, -1.2), (0.0, turn, 0.0)), unit)


def test_candidates_are_those_that_share_voxels_best_first() -> None:
    keyframes = [_last(), _seen_at(1, 0.1), _seen_at(2, 0.8), _seen_at(3, 0.0, turn=3.1)]
    index = VoxelIndex(relative_voxel_size(keyframes[0], CONFIG))
    for keyframe in keyframes:
        index.insert(keyframe.keyframe_id, confident_points(keyframe, CONFIG))
    got = sigma.candidates(index, 9, CONFIG)
    # the side walls reach behind the camera: what looks backwards may share a few voxels
    assert got[:2] == (1, 2)
    assert sigma.candidates(index, 9, replace(CONFIG, candidates=1)) == (1,)


def test_gain_is_that_of_the_kalman_update() -> None:
    """The determinant lemma against the paper's equation, written out for every point."""
    last, other = _last(), _seen_at(1, 0.3, unit=0.6)
    config = replace(CONFIG, points=40, depth_tolerance=1.0)
    prior = sigma._uncertain_points(last, config)
    view = sigma._seen_from([other], last, prior, config)
    T = sim3.inverse(other.T_world_kf) @ last.T_world_kf
    J = torch.stack([torch.func.jacfwd(lambda x: rays.rays_of(T[:3, :3] @ x + T[:3, 3]))(x)
                     for x in prior.points.T])
    P, R, predicted = (M.movedim(-1, 0) for M in (prior.covariance, view.R[0], view.predicted[0]))
    torch.testing.assert_close(predicted, J @ P @ J.mT, rtol=1e-9, atol=1e-15)
    posterior = P - P @ J.mT @ torch.linalg.inv(R + J @ P @ J.mT) @ J @ P
    gain = 0.5 * torch.log(torch.linalg.det(P) / torch.linalg.det(posterior))
    got = sigma.rerank(last, [other], config)
    assert got[0].gain == pytest.approx(float(gain[view.visible[0]].sum()), rel=1e-6)


def test_a_covariance_is_that_of_the_inverse_projection() -> None:
    """z K^-1 (u, v, 1), its Jacobian by automatic differentiation."""
    points = torch.tensor([[0.3, -0.4, 2.0], [-1.0, 0.2, 3.5]], dtype=torch.float64)
    confidence, K = torch.tensor([3.0, 9.0], dtype=torch.float64), box_room.K

    def unprojected(measured: Tensor) -> Tensor:
        ray = torch.cat([(measured[:2] - K[:2, 2]) / K.diagonal()[:2], torch.ones(1).double()])
        return measured[2] * ray

    got = sigma._covariance(points.T, confidence, 4.0, K.diagonal()[:2], CONFIG)
    for x, c, covariance in zip(points, confidence, got.unbind(-1)):
        uv = camera.project(x, K)
        J = torch.func.jacfwd(unprojected)(torch.cat([uv, x[2:]]))
        pixel = torch.tensor(CONFIG.sigma_px ** 2)
        noise = torch.stack([pixel, pixel,
                             (CONFIG.sigma_depth * x[2]) ** 2 * 4.0 / (c - 1.0)])
        torch.testing.assert_close(covariance, (J * noise) @ J.T, rtol=1e-9, atol=1e-15)


def test_a_covariance_reaches_the_rays_by_their_derivative() -> None:
    X = torch.tensor([[0.3, -0.4, 2.0], [-1.0, 0.2, 3.5]], dtype=torch.float64)
    half = torch.randn(2, 3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    M = half @ half.mT
    D = torch.stack([torch.func.jacfwd(rays.rays_of)(x) for x in X])
    got = sigma._on_rays(M.movedim(0, -1), X.T).movedim(-1, 0)
    torch.testing.assert_close(got, D @ M @ D.mT, rtol=1e-9, atol=1e-12)


def test_parallax_informs_more_than_a_copy_of_the_view() -> None:
    ranked = sigma.rerank(_last(), [_seen_at(1, 0.01), _seen_at(2, 0.15), _seen_at(3, 0.3)],
                          CONFIG)
    assert [r.keyframe_id for r in ranked] == [3, 2, 1]
    assert all(r.gain > 0 for r in ranked)


def test_gain_does_not_depend_on_units() -> None:
    one, other = (sigma.rerank(box_room.keyframe(9, LAST, unit=a), [_seen_at(1, 0.3, unit=b)],
                               CONFIG)[0].gain for a, b in ((1.0, 1.0), (0.2, 30.0)))
    assert one == pytest.approx(other, rel=1e-3)   # float32 points; visibility at image borders


def test_a_view_that_sees_nothing_of_it_informs_of_nothing() -> None:
    backwards = _seen_at(1, 0.0, turn=3.1)
    assert sigma.rerank(_last(), [backwards], CONFIG) == [sigma.Ranked(1, 0.0)]


def test_occluded_points_do_not_count() -> None:
    wall = box_room.keyframe(1, _seen_at(1, 0.3).T_world_kf,
                             depth=torch.full((box_room.HEIGHT, box_room.WIDTH), 0.4).double())
    assert sigma.rerank(_last(), [wall], CONFIG)[0].gain == 0.0


def test_a_confident_keyframe_has_less_to_gain() -> None:
    last, view = _last(), _seen_at(1, 0.3)
    settled = replace(last, confidence=5 * last.confidence, observations=5)
    assert sigma.rerank(settled, [view], CONFIG)[0].gain < \
        sigma.rerank(last, [view], CONFIG)[0].gain


def test_nothing_to_rank() -> None:
    last, view = _last(), _seen_at(1, 0.3)
    assert sigma.rerank(last, [], CONFIG) == []
    assert sigma.rerank(last, [last], CONFIG) == []
    empty = replace(last, points_cam=torch.full_like(last.points_cam, float('nan')))
    assert sigma.rerank(empty, [view], CONFIG) == [sigma.Ranked(1, 0.0)]
    assert sigma.rerank(last, [replace(view, points_cam=empty.points_cam)],
                        CONFIG) == [sigma.Ranked(1, 0.0)]


@dataclass(frozen=True)
class _Scripted:
    kappa: float
    ok: bool = True


def _activate(kappas: Sequence[float | None], ids: Sequence[int],
              config: SigmaConfig = CONFIG) -> sigma.Activation[_Scripted]:
    """Attempts that give these kappas in turn; None is one that does not track."""
    script = iter(kappas)

    def attempt(window: tuple[int, ...], before: _Scripted | None) -> _Scripted:
        kappa = next(script)
        return _Scripted(0.0, ok=False) if kappa is None else _Scripted(kappa)

    return sigma.activate(9, ids, attempt, lambda _, remaining: sorted(remaining), config)


def test_a_stable_window_stays_at_three_views() -> None:
    got = _activate([0.9], [5, 4, 3])
    assert got.window == (9, 5) and got.tried == ((9, 5),)


def test_a_window_grows_while_kappa_falls() -> None:
    got = _activate([3.0, 2.0, 0.8], [5, 4, 3, 2])
    assert got.window == (9, 5, 2, 3)   # reordered after every attempt
    assert got.attempt.kappa == 0.8 and len(got.tried) == 3


def test_a_window_has_at_most_five_views() -> None:
    got = _activate([5.0, 4.0, 3.0], [6, 5, 4, 3, 2, 1])
    assert len(got.window) == 4 and got.attempt.kappa == 3.0


def test_an_attempt_knows_which_one_it_widens() -> None:
    seen: list[tuple[tuple[int, ...], _Scripted | None]] = []

    def attempt(window: tuple[int, ...], before: _Scripted | None) -> _Scripted:
        seen.append((window, before))
        return _Scripted(5.0 - len(seen))
    sigma.activate(9, [7, 5, 4], attempt, lambda _, remaining: remaining, CONFIG)
    assert seen == [((9, 7), None), ((9, 7, 5), _Scripted(4.0)),
                    ((9, 7, 5, 4), _Scripted(3.0))]


def test_an_unhelpful_view_takes_the_window_back_to_three() -> None:
    assert _activate([3.0, 4.0], [5, 4, 3]).window == (9, 5)
    got = _activate([3.0, 2.0, 2.5], [5, 4, 3])
    assert got.window == (9, 5) and got.attempt.kappa == 3.0 and len(got.tried) == 3


def test_a_wider_window_can_save_an_attempt_that_failed() -> None:
    assert _activate([None, 0.5], [5, 4]).window == (9, 5, 4)
    assert not _activate([None, None], [5, 4]).attempt.ok
    assert _activate([3.0, None], [5, 4]).attempt.kappa == 3.0


def test_a_map_with_one_keyframe_has_no_candidate() -> None:
    got = _activate([7.0], [])
    assert got.window == (9,) and got.tried == ((9,),)
    assert _activate([7.0], [5, 4], replace(CONFIG, max_window=2)).window == (9,)


def test_a_window_may_start_wider() -> None:
    wider = replace(CONFIG, min_window=5, max_window=6)
    assert _activate([0.5], [6, 5, 4, 3, 2], wider).tried == ((9, 6, 5, 4),)
    got = _activate([3.0, 4.0], [6, 5, 4, 3, 2], wider)
    assert got.window == (9, 6, 5, 4) and len(got.tried) == 2, 'back to where it started'
    assert _activate([3.0], [6, 5, 4], replace(CONFIG, min_window=9)).window == (9, 6, 5, 4)
