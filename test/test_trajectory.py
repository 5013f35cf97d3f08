"""Absolute trajectory error: known similarities are undone, the undeterminable is said."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from aim_slam_ros.evaluation.trajectory import (Incomparable, TrajectoryError, compare, during,
                                                length, tolerance_s)
from aim_slam_ros.geometry import sim3
from aim_slam_ros.types import StampedPoses

START_NS = 1_305_031_102_175_304_123    # of today's size: float64 seconds lose its last digits


def helix(count: int = 60, step_ns: int = 33_333_333) -> StampedPoses:
    """A camera on a helix of 1 m radius."""
    angle = torch.linspace(0, 4, count, dtype=torch.float64)
    zero = torch.zeros_like(angle)
    rotation = sim3.rotation_of(sim3.exp(torch.stack([zero] * 4 + [angle, zero, zero], -1)))
    positions = torch.stack([angle.cos(), angle.sin(), 0.2 * angle], -1)
    T = sim3.from_parts(torch.ones(count), rotation, positions)
    return StampedPoses(START_NS + step_ns * np.arange(count), T.numpy())


def seen_from_elsewhere(poses: StampedPoses, scale: float) -> StampedPoses:
    """The same path in a world with another origin, orientation and unit."""
    T = sim3.exp(torch.tensor([3.0, -2.0, 5.0, 0.4, -1.1, 0.7, np.log(scale)],
                              dtype=torch.float64))
    moved = sim3.rigid_part(T @ torch.from_numpy(poses.T_world_cam))
    return StampedPoses(poses.stamps_ns, moved.numpy())


def error_of(estimate: StampedPoses, truth: StampedPoses) -> TrajectoryError:
    error = compare(estimate, truth)
    assert isinstance(error, TrajectoryError), error
    return error


@pytest.mark.parametrize('scale', [1e-6, 0.37, 1.0, 2e4])
def test_a_similarity_is_undone(scale: float) -> None:
    """Exact data leaves rounding only; no unit is too small or large."""
    truth = helix()
    estimate = seen_from_elsewhere(truth, scale)
    error = error_of(estimate, truth)
    assert error.ate_rmse_m < 1e-6
    assert error.scale == pytest.approx(1 / scale, rel=1e-6)
    assert error.matched == len(truth)
    np.testing.assert_array_equal(error.aligned.stamps_ns, truth.stamps_ns)
    np.testing.assert_allclose(error.aligned.T_world_cam, truth.T_world_cam, atol=1e-6)
    points = np.c_[estimate.T_world_cam[:, :3, 3], np.ones(len(truth))]
    np.testing.assert_allclose((points @ error.T_reference_estimate.T)[:, :3],
                               truth.T_world_cam[:, :3, 3], atol=1e-6)


def test_noise_of_known_size_is_measured() -> None:
    """3 axes of 1 cm: 1.73 cm, less the share that 7 aligned parameters absorb; 10 % luck."""
    truth = helix(400)
    noisy = truth.T_world_cam.copy()
    noisy[:, :3, 3] += np.random.default_rng(0).normal(0, 0.01, (400, 3))
    error = error_of(StampedPoses(truth.stamps_ns, noisy), truth)
    assert error.ate_rmse_m == pytest.approx(0.0173, rel=0.1)
    assert error.ate_rmse_m == pytest.approx(np.sqrt(np.mean(error.errors_m ** 2)))


def test_only_poses_close_in_time_are_paired() -> None:
    truth = helix()
    late = StampedPoses(truth.stamps_ns + 8_000_000, truth.T_world_cam)
    assert error_of(late, truth).matched == len(truth)
    holes = np.r_[0:20, 40:60]
    gappy = StampedPoses(truth.stamps_ns[holes], truth.T_world_cam[holes])
    error = error_of(truth, gappy)
    assert error.matched == len(holes)
    assert error.ate_rmse_m < 1e-6


@pytest.mark.parametrize('step_ms, expected_s',
                         [(5, 0.01), (33.333333, 0.0166666665), (100, 0.02)])
def test_tolerance_follows_the_spacing(step_ms: float, expected_s: float) -> None:
    assert tolerance_s(helix(step_ns=round(step_ms * 1e6))) == pytest.approx(expected_s)


def test_what_cannot_be_compared_is_said() -> None:
    truth = helix()
    few = StampedPoses(truth.stamps_ns[:2], truth.T_world_cam[:2])
    later = StampedPoses(truth.stamps_ns + 10**12, truth.T_world_cam)
    overlapping = StampedPoses(truth.stamps_ns + 58 * 33_333_333, truth.T_world_cam)
    still = StampedPoses(truth.stamps_ns, np.repeat(truth.T_world_cam[:1], 60, 0))
    line = truth.T_world_cam.copy()
    line[:, 1:3, 3] = 0.0
    broken = truth.T_world_cam.copy()
    broken[5, 0, 3] = np.nan
    for estimate, reason in ((few, 'at least 3'), (later, 'close enough in time'),
                             (overlapping, 'only 2 poses'), (still, 'never moved'),
                             (StampedPoses(truth.stamps_ns, line), 'along a line'),
                             (StampedPoses(truth.stamps_ns, broken), 'non-finite')):
        error = compare(estimate, truth)
        assert isinstance(error, Incomparable) and reason in error.reason
    empty = StampedPoses(np.zeros(0, np.int64), np.zeros((0, 4, 4)))
    assert isinstance(compare(empty, truth), Incomparable)
    assert isinstance(compare(truth, empty), Incomparable)


def test_length() -> None:
    """A helix of radius 1 and pitch .2 over 4 rad; chords of 4/999 rad are 1e-6 too short."""
    assert length(helix(1000)) == pytest.approx(4 * np.hypot(1, 0.2), rel=1e-5)
    assert length(helix(1)) == 0.0


def test_a_time_span_includes_its_ends() -> None:
    truth = helix()
    part = during(truth, int(truth.stamps_ns[3]), int(truth.stamps_ns[7]))
    assert part.stamps_ns.tolist() == truth.stamps_ns[3:8].tolist()
    np.testing.assert_array_equal(part.T_world_cam, truth.T_world_cam[3:8])
