"""The paper's solve on scenes of known geometry.

Where the prediction's own poses are wrong, its matches are wrong in the same way and the solve
follows them: what it can repair, and what is tested here, is a wrong state, that is
keyframe poses, scales and guesses that disagree with the prediction.
"""

from __future__ import annotations

import math
from dataclasses import replace

import box_room
import pytest
import real_depth
import torch
from torch import Tensor

from aim_slam_ros.config import JointTrackingConfig
from aim_slam_ros.frontend import joint_solver
from aim_slam_ros.frontend.alignment import pose_mean
from aim_slam_ros.frontend.joint_residuals import PairMatches, PairResiduals
from aim_slam_ros.frontend.joint_tracking import JointTracker
from aim_slam_ros.frontend.tracking import TrackingResult, TrackingWindow
from aim_slam_ros.geometry import camera, rays, sim3

CONFIG = JointTrackingConfig()
UNIT = 0.7   # metres per unit of the prediction
UNITS = (1.0, 1.3, 0.8, 1.1)   # of the keyframes


def _window(views: int, noise: float = 0.0, observations: int = 20, wrong: Tensor | None = None,
            pose_noise: tuple[float, float] = (0.0, 0.0), seed: int = 0) -> TrackingWindow:
    """The current frame is the last of the trajectory; ``wrong`` displaces the last keyframe."""
    T = box_room.trajectory(views)
    guess = [T_k if wrong is None or k < views - 2 else sim3.exp(wrong) @ T_k
             for k, T_k in enumerate(T[:-1])]
    keyframes = tuple(box_room.keyframe(k, T[k], UNITS[k], T_guess=guess[k],
                                        observations=observations) for k in range(views - 1))
    prediction = box_room.prediction([T[-1], *T[:-1]], UNIT, noise, pose_noise, seed)
    return TrackingWindow(keyframes[0].frame, prediction, keyframes)


def _truth(views: int) -> Tensor:
    return sim3.with_scale(box_room.trajectory(views)[-1], UNIT)


def _errors(T: Tensor, truth: Tensor) -> tuple[float, float, float]:
    """Rotation [deg], translation [world units], scale (relative)."""
    return (math.degrees(sim3.angle_rad(T, truth)), float((T - truth)[:3, 3].norm()),
            abs(float(sim3.scale_of(T) / sim3.scale_of(truth)) - 1.0))


@pytest.mark.parametrize('residual', ['ray', 'projection', 'hybrid'])
@pytest.mark.parametrize('pairs', ['adjacent', 'composed'])
@pytest.mark.parametrize('views', [2, 3, 5])
def test_a_consistent_window_stays_where_it_is(views: int, pairs: str, residual: str) -> None:
    config = replace(CONFIG, pairs=pairs, residual=residual)
    got = JointTracker(config).track(_window(views, noise=0.005))
    rotation, translation, scale = _errors(got.T_world_frame, _truth(views))
    # 0.5 % of depth noise over a thousand points; curved depth between pixels gives the rest
    assert got.ok and rotation < 0.05 and translation < 0.004 and scale < 0.005
    assert got.matched_fraction > 0.6
    assert set(got.moved) == set(range(1, views - 1))


def test_rounding_does_not_grow_from_window_to_window() -> None:
    """Each keyframe's pose is made of the inverse of the one before: what is off doubles."""
    window, tracker = _window(4), JointTracker(CONFIG)
    off = torch.zeros(4, 4, dtype=torch.float64)
    off[0, 1] = 1e-9
    window = replace(window, keyframes=tuple(
        replace(k, T_world_kf=k.T_world_kf + off) for k in window.keyframes))
    for _ in range(40):     # 1e-9 doubled 30 times is 1
        got = tracker.track(window)
        window = replace(window, keyframes=tuple(
            replace(k, T_world_kf=got.moved.get(k.keyframe_id, k.T_world_kf))
            for k in window.keyframes))
    for T in (got.T_world_frame, *got.moved.values()):
        R = sim3.rotation_of(T)
        assert torch.allclose(R @ R.T, torch.eye(3).double(), rtol=0.0, atol=1e-12)
    assert _errors(got.T_world_frame, _truth(4))[1] < 0.004


WRONG = torch.tensor([0.05, -0.03, 0.04, 0.01, -0.012, 0.008, 0.03])   # 1 degree, 7 cm, 3 %


@pytest.mark.parametrize('residual', ['ray', 'projection', 'hybrid'])
def test_a_wrong_keyframe_is_moved_back_and_the_frame_with_it(residual: str) -> None:
    """Without memory; the guess is the mean over a right and a wrong keyframe."""
    config = replace(CONFIG, memory=0.0, residual=residual)
    window = _window(3, noise=0.01, wrong=WRONG.double())
    guess, got = pose_mean(window, 0.05), JointTracker(config).track(window)
    truth = _truth(3)
    assert guess is not None
    before, after = _errors(guess, truth), _errors(got.T_world_frame, truth)
    assert all(b < a / 3 for a, b in zip(before, after)) and after[2] < 0.015
    T_kf = sim3.with_scale(box_room.trajectory(3)[1], UNITS[1])
    before, after = (_errors(T, T_kf) for T in (window.keyframes[1].T_world_kf, got.moved[1]))
    assert all(b < a / 3 for a, b in zip(before, after))


def test_a_keyframe_observed_n_times_moves_by_one_share_in_n_plus_one() -> None:
    # adjacent pairs: one with the current frame in it would pull at the keyframe as well
    config = replace(CONFIG, pairs='adjacent', huber=100.0)
    wrong = 0.2 * WRONG.double()   # small enough to be linear
    truth = sim3.with_scale(box_room.trajectory(3)[1], UNITS[1])
    for n in (1, 4):
        window = _window(3, wrong=wrong, observations=n)
        moved = JointTracker(config).track(window).moved[1]
        left = sim3.log(moved @ sim3.inverse(truth))
        torch.testing.assert_close(left, wrong * n / (n + 1), rtol=0.1, atol=5e-4)


def test_the_scale_of_the_prediction_is_recovered() -> None:
    window = _window(3)
    for unit in (0.05, 40.0):
        prediction = replace(window.prediction, depth=window.prediction.depth * (UNIT / unit),
                             T_first_cam=sim3.from_parts(
                                 1.0, window.prediction.T_first_cam[:, :3, :3],
                                 window.prediction.T_first_cam[:, :3, 3] * (UNIT / unit)))
        got = JointTracker(CONFIG).track(replace(window, prediction=prediction))
        assert float(sim3.scale_of(got.T_world_frame)) == pytest.approx(unit, rel=5e-3)


def test_a_matched_fraction_is_what_overlaps() -> None:
    T = box_room.trajectory(1)[0]
    turned = T @ box_room.pose((0.0, 0.0, 0.0), (0.0, math.radians(25.0), 0.0))
    window = TrackingWindow(box_room.keyframe(0, T).frame,
                            box_room.prediction([turned, T], UNIT), (box_room.keyframe(0, T),))
    got = JointTracker(CONFIG).track(window)
    # by tan: of 65 degrees, what lies 7.5 degrees right of the axis and beyond is not seen
    seen = 0.5 + 0.5 * math.tan(math.radians(7.5)) / math.tan(math.radians(32.5))
    assert got.matched_fraction == pytest.approx(seen, abs=0.06)


def _refused(window: TrackingWindow, config: JointTrackingConfig = CONFIG) -> TrackingResult:
    got = JointTracker(config).track(window)
    assert not got.ok and got.reason and not got.moved and math.isinf(got.kappa)
    return got


def test_expected_failures_are_results_with_a_reason() -> None:
    window = _window(2)
    assert 'no keyframe' in _refused(TrackingWindow(
        window.frame, box_room.prediction(box_room.trajectory(1), UNIT), ())).reason
    assert 'rotation' in _refused(replace(window, prediction=replace(
        window.prediction, rotation_only=True))).reason
    back = box_room.pose((0.0, 0.0, 0.0), (0.0, 3.0, 0.0))
    away = replace(window.prediction, T_first_cam=torch.stack([sim3.identity(), back]))
    assert 'shares' in _refused(replace(window, prediction=away)).reason
    blind = replace(window.keyframes[0],
                    points_cam=torch.full_like(window.keyframes[0].points_cam, math.nan))
    assert 'no depth' in _refused(replace(window, keyframes=(blind,))).reason


def test_a_window_that_is_not_the_predictions_is_refused_by_name() -> None:
    window = _window(3)
    with pytest.raises(ValueError, match='infer the window'):
        JointTracker(CONFIG).track(replace(window, keyframes=window.keyframes[:1]))
    small = replace(window.keyframes[0], confidence=torch.ones(4, 4))
    with pytest.raises(ValueError, match='one image size'):
        JointTracker(CONFIG).track(replace(window, keyframes=(small, window.keyframes[1])))


def test_keyframes_that_share_nothing_with_each_other_hold_still() -> None:
    """Both overlap the current frame, not each other: their link has only its memory."""
    T = box_room.pose((0.0, 0.0, -1.0), (0.0, 0.0, 0.0))
    left, right = (T @ box_room.pose((0.0, 0.0, 0.0), (0.0, math.radians(a), 0.0))
                   for a in (-38.0, 38.0))
    keyframes = (box_room.keyframe(0, left), box_room.keyframe(1, right, 1.3))
    window = TrackingWindow(keyframes[0].frame, box_room.prediction([T, left, right], UNIT),
                            keyframes)
    got = JointTracker(replace(CONFIG, memory=0.0)).track(window)
    assert got.ok and _errors(got.T_world_frame, sim3.with_scale(T, UNIT))[0] < 0.1
    torch.testing.assert_close(got.moved[1], keyframes[1].T_world_kf, atol=5e-3, rtol=0)


def _noisy_pair(noise_rad: float, noise_log: float) -> PairMatches:
    """A view matched with itself, with noise on the rays and on the log-distances."""
    rng = torch.Generator().manual_seed(0)
    X = camera.unproject(box_room.depth_of(box_room.trajectory(1)[0]), box_room.K)
    X = X[::4, ::4].reshape(-1, 3)
    d = X.norm(dim=-1, keepdim=True)
    # r x n is n without its part along r, turned: noise_rad on each of the ray's two axes.
    sideways = noise_rad * torch.linalg.cross(
        X / d, torch.randn(X.shape, generator=rng, dtype=X.dtype))
    log_d = noise_log * torch.randn(d.shape, generator=rng, dtype=X.dtype)
    seen = rays.rays_of(X / d + sideways) * d * log_d.exp()
    return PairMatches(0, 1, X.float(), seen.float(), torch.ones(len(X)), box_room.K, 325.0, 3.0,
                       sim3.identity(), None)


def test_kappa_is_one_where_the_noise_is_what_the_sigmas_say() -> None:
    """Noise of sigma per axis: 2 degrees of freedom of the ray, 1 of the distance."""
    quiet = _noisy_pair(CONFIG.sigma_ray, CONFIG.sigma_log_distance)
    loud = _noisy_pair(2 * CONFIG.sigma_ray, 2 * CONFIG.sigma_log_distance)
    start = sim3.identity()[None]
    config = replace(CONFIG, residual='ray')
    # thousands of residuals: chi-square spreads by sqrt(2/9600) = 1.4 %
    assert joint_solver.solve(start, (quiet,), config).kappa == pytest.approx(1.0, abs=0.06)
    assert joint_solver.solve(start, (loud,), config).kappa == pytest.approx(4.0, abs=0.25)


@pytest.mark.parametrize('residual', ['ray', 'projection', 'hybrid'])
def test_the_basin_is_wide(residual: str) -> None:
    """From 30 degrees, half the depth and a factor of 2 away."""
    pair, config = _noisy_pair(1e-3, 1e-2), replace(CONFIG, residual=residual)
    for seed in range(6):
        xi = torch.randn(7, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        xi = xi / xi.norm() * torch.tensor([1.5, 1.5, 1.5, 0.5, 0.5, 0.5, 0.7])
        got = joint_solver.solve(sim3.exp(xi)[None], (pair,), config)
        assert float(sim3.log(got.links[0]).norm()) < 0.01


def test_points_behind_the_camera_are_no_refuge() -> None:
    pair = _noisy_pair(1e-3, 1e-2)
    turned = box_room.pose((0.0, 0.0, 0.0), (0.0, 3.1, 0.0))[None]
    residuals = PairResiduals((pair,), CONFIG)
    for kind in ('ray', 'projection', 'hybrid'):
        ahead = residuals.linearise(box_room.pose((0, 0, 0), (0, 0.5, 0))[None], kind)
        behind = residuals.linearise(turned, kind)
        assert float(behind.cost) > float(ahead.cost)
        assert int(behind.rows) == 0 and float(behind.equations.H.abs().max()) == 0.0


@pytest.mark.skipif(not real_depth.SEQUENCE.exists(), reason='the recorded depth is not here')
@pytest.mark.parametrize('start', [30, 60, 100])
def test_recorded_depth_repairs_a_wrong_keyframe(start: int) -> None:
    """A simulated prediction from Kinect depth and motion capture of fr1_xyz.

    The recording's own depths disagree with its own poses by 1 % here, by up to 2.6 % where the
    camera moves along its axis: the scale cannot be better than that.
    """
    seen, K = real_depth.views([start, start + 3, start + 6]), real_depth.intrinsics()
    truth = [view.T_world_cam for view in seen]
    noisy = [view.depth * (1 + 0.0075 * torch.randn(
        view.depth.shape, generator=torch.Generator().manual_seed(k), dtype=torch.float64))
        for k, view in enumerate(seen)]
    prediction = box_room.prediction([truth[2], *truth[:2]], UNIT, depths=[noisy[2], *noisy[:2]])
    prediction = replace(prediction, K=K.expand(3, 3, 3))
    scale = float(seen[0].depth.nanmedian())
    wrong = torch.tensor([0.02, -0.015, 0.015, 0.01, -0.012, 0.008, 0.03]).double()
    wrong[:3] *= scale
    keyframes = []
    for k, T in enumerate((truth[0], truth[1] @ sim3.exp(wrong))):
        keyframe = box_room.keyframe(k, T, UNITS[k], depth=seen[k].depth)
        points = camera.unproject((seen[k].depth / UNITS[k]).float(), K)
        keyframes.append(replace(keyframe, K=K, points_cam=points))
    window = TrackingWindow(keyframes[0].frame, prediction, tuple(keyframes))
    guess = pose_mean(window, 0.05)
    got = JointTracker(replace(CONFIG, memory=0.0)).track(window)
    assert guess is not None and got.ok, got.reason
    target = sim3.with_scale(truth[2], UNIT)
    before, after = _errors(guess, target), _errors(got.T_world_frame, target)
    assert after[0] < before[0] / 3 and after[1] < before[1] / 3 and after[2] < 0.015


def test_guessed_depth_is_not_matched() -> None:
    window = _window(2)
    confidence = window.prediction.confidence.clone()
    confidence[0, :, box_room.WIDTH // 2:] = 1.0
    depth = window.prediction.depth.clone()
    depth[0, :, box_room.WIDTH // 2:] = 1.0   # a prior, and wrong
    got = JointTracker(CONFIG).track(replace(window, prediction=replace(
        window.prediction, depth=depth, confidence=confidence)))
    whole = JointTracker(CONFIG).track(window)
    assert got.matched_fraction < 0.6 * whole.matched_fraction
    assert _errors(got.T_world_frame, _truth(2))[0] < 0.05
