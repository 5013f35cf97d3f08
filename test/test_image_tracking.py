"""The default tracker: predicted matches refined in the images."""

from __future__ import annotations

import math

import clip as clips
import pytest
import torch
from clip import Clip
from torch import Tensor

from aim_slam_ros.frontend.image_tracking import ImageTracker
from aim_slam_ros.frontend.tracking import TrackingResult, TrackingWindow
from aim_slam_ros.geometry import sim3
from aim_slam_ros.types import WindowPrediction

UNIT = 0.6      # metres per unit of the prediction
KEYFRAMES, UNITS = [10, 14], (1.0, 2.0)
CURRENT = 12


def _prediction(clip: Clip, pose_error: Tensor | None = None) -> WindowPrediction:
    """True but for the unit, and the pose of every keyframe moved by ``pose_error``."""
    views = [CURRENT, *KEYFRAMES]
    depth = torch.stack([clip.depth_of(i) for i in views]) / UNIT
    T = torch.stack([clip.T_a_b(CURRENT, i) for i in views])
    if pose_error is not None:
        T[1:] = sim3.exp(pose_error) @ T[1:]
    T[:, :3, 3] /= UNIT
    K = clip.frame(0).K
    assert K is not None
    return WindowPrediction(depth, torch.full(depth.shape, 6.0), K.expand(3, 3, 3), T)


def _track(clip: Clip, prediction: WindowPrediction, guess: Tensor | None = None,
           **values: object) -> TrackingResult:
    config = clips.config(**values)
    tracker = ImageTracker(config.tracking, config.following, config.keyframes.min_confident)
    return tracker.track(TrackingWindow(clip.frame(CURRENT), prediction,
                                        clips.true_map(clip, KEYFRAMES, UNITS).piece, guess))


def _errors(T: Tensor, clip: Clip) -> tuple[float, float, float]:
    """Rotation [deg], position [m], scale (relative)."""
    truth = sim3.with_scale(clip.T_world_cam[CURRENT], UNIT)
    return (math.degrees(sim3.angle_rad(T, truth)), float((T - truth)[:3, 3].norm()),
            abs(float(sim3.scale_of(T)) / UNIT - 1.0))


ERROR = torch.tensor([0.06, -0.04, 0.05, 0.01, 0.012, -0.01, 0.0], dtype=torch.float64)


def test_the_images_correct_the_models_poses(clip: Clip) -> None:
    """9 cm and 1.1 degrees wrong in every view: no mean over the views helps."""
    got = _track(clip, _prediction(clip, ERROR))
    rotation, position, scale = _errors(got.T_world_frame, clip)
    assert got.ok and rotation < 0.2 and position < 0.015 and scale < 0.02
    assert math.isfinite(got.kappa) and 0.5 < got.matched_fraction <= 1.0
    assert got.moved == {}


def test_kappa_is_how_far_off_the_model_is_in_the_images(clip: Clip) -> None:
    """A turn of .01 rad about the optical axis moves a pixel by that share of its distance from
    the middle; the pose that is found stays the same. A right model leaves the noise of the
    matches and of the stored depths, below a pixel."""
    turn = torch.tensor([0, 0, 0, 0, 0, 0.01, 0], dtype=torch.float64)
    right, wrong = (_track(clip, _prediction(clip, error), clip.T_world_cam[CURRENT],
                           tracking__sigma_model_px=1.0) for error in (None, turn))
    assert right.kappa < 1.0
    frame = clip.frame(CURRENT)
    spread = math.hypot(frame.height, frame.width) / math.sqrt(12.0)   # of a filled rectangle
    assert wrong.kappa == pytest.approx(0.5 * (0.01 * spread) ** 2, rel=0.5)
    assert torch.allclose(right.T_world_frame, wrong.T_world_frame, atol=1e-6)
    calmer = _track(clip, _prediction(clip, turn), clip.T_world_cam[CURRENT],
                    tracking__sigma_model_px=3.0)
    assert calmer.kappa == pytest.approx(wrong.kappa / 9.0)


def test_a_model_that_places_nothing_cannot_be_worse(clip: Clip) -> None:
    """The images found the pose from where it was followed to: it counts, and kappa asks for
    more views."""
    prediction = _prediction(clip)
    prediction.confidence[1:] = 1.001
    got = _track(clip, prediction, clip.T_world_cam[CURRENT])
    assert got.ok and got.optimised and got.kappa == math.inf


def test_each_keyframe_measures_for_itself(clip: Clip) -> None:
    got = _track(clip, _prediction(clip, ERROR))
    assert set(got.measured()) == {0, 1}
    for keyframe_id, index in enumerate(KEYFRAMES):
        T_world_kf = sim3.with_scale(clip.T_world_cam[index], UNITS[keyframe_id])
        _, position, scale = _errors(T_world_kf @ got.measured()[keyframe_id], clip)
        assert position < 0.03 and scale < 0.03


def test_a_guess_goes_before_the_models_pose(clip: Clip) -> None:
    far = torch.tensor([1.5, 0, 0, 0, 0.6, 0, 0], dtype=torch.float64)
    got = _track(clip, _prediction(clip, far), clip.T_world_cam[CURRENT])
    assert got.ok and _errors(got.T_world_frame, clip)[1] < 0.015


def test_with_too_few_matches_the_start_is_kept(clip: Clip) -> None:
    got = _track(clip, _prediction(clip, ERROR), tracking__min_matches=50000)
    assert got.ok and not got.optimised and got.kappa == math.inf and got.measured() == {}
    # the keyframes' errors, seen from the current view
    assert 0.05 < _errors(got.T_world_frame, clip)[1] < 0.15


def test_a_solve_that_strays_is_not_believed(clip: Clip) -> None:
    wrong = clip.T_world_cam[CURRENT].clone()
    wrong[:3, 3] += 0.05
    got = _track(clip, _prediction(clip), wrong, tracking__max_stray=0.01)
    assert got.kappa == math.inf
    assert _track(clip, _prediction(clip), wrong, tracking__max_stray=0.5).kappa < math.inf


@pytest.mark.parametrize('guessed', [False, True])
def test_where_nobody_knows_it_says_why(clip: Clip, guessed: bool) -> None:
    prediction = _prediction(clip)
    prediction.confidence[:] = 1.001
    far = clip.T_world_cam[CURRENT].clone()
    far[:3, 3] += 40.0
    got = _track(clip, prediction, far if guessed else None)
    assert not got.ok and isinstance(got.reason, str) and got.reason
    assert got.measured() == {} and got.moved == {}
