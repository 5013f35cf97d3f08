"""An inference brought to the units of the map."""

from __future__ import annotations

import math
from dataclasses import replace

import box_room
import pytest
import torch

from aim_slam_ros.config import KeyframesConfig
from aim_slam_ros.frontend.alignment import fused, observed, pose_mean, unit_of
from aim_slam_ros.frontend.tracking import TrackingWindow
from aim_slam_ros.geometry import camera, sim3
from aim_slam_ros.types import WindowPrediction

UNIT = 0.6      # metres per unit of the prediction


def _window(views: int = 4, noise: float = 0.0,
            pose_noise: tuple[float, float] = (0.0, 0.0)) -> TrackingWindow:
    T = box_room.trajectory(views)
    keyframes = tuple(box_room.keyframe(k, T[k], 0.8 + 0.3 * k) for k in range(views - 1))
    prediction = box_room.prediction([T[-1], *T[:-1]], UNIT, noise, pose_noise)
    return TrackingWindow(keyframes[0].frame, prediction, keyframes)


def test_unit_of_each_keyframe() -> None:
    window = _window(noise=0.05)
    for view, keyframe in enumerate(window.keyframes, 1):
        got = unit_of(keyframe, window.prediction, view)
        truth = UNIT / float(sim3.scale_of(keyframe.T_world_kf))
        # the median of 3000 ratios with 5 per cent of noise each
        assert got.scale == pytest.approx(truth, rel=0.005)
        assert got.spread == pytest.approx(0.05, rel=0.15)


def test_what_was_not_seen_has_no_say_in_the_unit() -> None:
    window = _window()
    prediction = window.prediction
    prediction.depth[1, :150] *= 3.0
    prediction.confidence[1, :150] = 1.0
    got = unit_of(window.keyframes[0], prediction, 1)
    assert got.scale == pytest.approx(UNIT / 0.8, rel=1e-3)


def test_pose_mean_is_the_pose_where_nothing_is_wrong() -> None:
    got = pose_mean(_window(), min_seen=0.1)
    assert got is not None
    truth = sim3.with_scale(box_room.trajectory(4)[-1], UNIT)
    assert torch.allclose(got, truth, atol=1e-5)


def test_pose_mean_averages_the_errors_of_the_views() -> None:
    """Three keyframes whose poses the model has wrong by 1 degree and 3 cm each."""
    window = _window(4, pose_noise=(0.02, 0.03))
    truth = box_room.trajectory(4)[-1]

    def error(keyframes: slice) -> float:
        chosen = list(range(3))[keyframes]
        index = [0, *(c + 1 for c in chosen)]
        p = window.prediction
        part = TrackingWindow(
            window.frame, WindowPrediction(p.depth[index], p.confidence[index], p.K[index],
                                           p.T_first_cam[index]),
            tuple(window.keyframes[c] for c in chosen))
        got = pose_mean(part, 0.1)
        assert got is not None
        return sim3.angle_rad(got, truth)

    alone = [error(slice(k, k + 1)) for k in range(3)]
    assert error(slice(0, 3)) < math.sqrt(sum(a * a for a in alone) / 3)


def test_unconnected_views_have_no_say() -> None:
    window = _window()
    window.prediction.confidence[2] = 1.001
    window.prediction.T_first_cam[2] = sim3.identity()
    got = pose_mean(window, min_seen=0.1)
    assert got is not None
    assert torch.allclose(got, sim3.with_scale(box_room.trajectory(4)[-1], UNIT), atol=1e-5)
    window.prediction.confidence[1:] = 1.001
    assert pose_mean(window, min_seen=0.1) is None


def test_fused_depth_is_a_weighted_log_mean_on_the_same_rays() -> None:
    keyframe = box_room.keyframe(0, box_room.trajectory(1)[0])
    prediction = box_room.prediction([box_room.trajectory(1)[0]], UNIT)
    prediction.depth[:] *= 1.1
    prediction.confidence[:] = 1.0 + 12.0     # the keyframe has 1 + 4
    got = fused(keyframe, prediction, 0, scale=UNIT)
    assert torch.allclose(got.points_cam[..., 2],
                          keyframe.points_cam[..., 2] * 1.1 ** 0.75, rtol=1e-5)
    assert torch.allclose(got.confidence, torch.tensor(17.0)) and got.observations == 2
    rays = [p / p[..., 2:] for p in (got.points_cam, keyframe.points_cam)]
    assert torch.allclose(rays[0], rays[1], atol=1e-6)


def test_fusing_many_noisy_observations_converges() -> None:
    T = box_room.trajectory(1)[0]
    keyframe = box_room.keyframe(0, T, depth=box_room.depth_of(T) * 1.2)
    truth = box_room.depth_of(T)

    def error() -> float:
        return float((keyframe.points_cam[..., 2] / truth).log().abs().mean())

    first = error()
    for seed in range(20):
        keyframe = fused(keyframe, box_room.prediction([T], 1.0, 0.05, seed=seed), 0, 1.0)
    # 1/21 of the first 18 per cent, and 5 per cent over the root of 20 observations
    assert error() < 0.12 * first and keyframe.observations == 21


def test_what_knows_nothing_changes_nothing() -> None:
    T = box_room.trajectory(1)[0]
    keyframe = box_room.keyframe(0, T)
    prediction = box_room.prediction([T], UNIT)
    prediction.depth[:] = 7.0
    prediction.confidence[:] = 1.0
    got = fused(keyframe, prediction, 0, 1.0)
    assert torch.allclose(got.points_cam, keyframe.points_cam)
    assert bool(torch.isfinite(got.points_cam).all())


def test_the_focal_length_is_averaged_over_all_observations() -> None:
    T = box_room.trajectory(1)[0]
    keyframe = box_room.keyframe(0, T, observations=3)
    prediction = box_room.prediction([T], 1.0)
    wide = prediction.K.clone()
    wide[:, 0, 0] *= 1.4
    wide[:, :2, 2] += 9.0
    changed = WindowPrediction(prediction.depth, prediction.confidence, wide,
                               prediction.T_first_cam)
    got = fused(keyframe, changed, 0, 1.0)
    assert float(got.K[0, 0] / keyframe.K[0, 0]) == pytest.approx(1.1)
    assert torch.equal(got.K[:2, 2], keyframe.K[:2, 2])
    uv = camera.project(got.points_cam, got.K)
    grid = camera.pixel_grid(box_room.HEIGHT, box_room.WIDTH)
    assert torch.allclose(uv, grid, atol=1e-2), 'points stay where they were seen'


def test_a_shared_focal_length_is_taken_as_it_is_known_by_now() -> None:
    T = box_room.trajectory(1)[0]
    keyframe, prediction = box_room.keyframe(0, T, observations=3), box_room.prediction([T], UNIT)
    prediction = replace(prediction, K=prediction.K.clone())
    prediction.K[:, [0, 1], [0, 1]] *= 1.1
    shared, own = (observed(keyframe, prediction, 0, KeyframesConfig(shared_focal=shared))
                   for shared in (True, False))
    assert float(shared.K[0, 0] / keyframe.K[0, 0]) == pytest.approx(1.1)
    assert float(own.K[0, 0] / keyframe.K[0, 0]) == pytest.approx(1.025)


def test_fusion_can_be_switched_off() -> None:
    T = box_room.trajectory(1)[0]
    keyframe, prediction = box_room.keyframe(0, T), box_room.prediction([T], UNIT)
    assert observed(keyframe, prediction, 0, KeyframesConfig()).observations == 2
    assert observed(keyframe, prediction, 0, KeyframesConfig(fuse=False)) is keyframe
