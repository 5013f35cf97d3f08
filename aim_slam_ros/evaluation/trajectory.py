"""Trajectories against ground truth; the only file that knows evo."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from evo.core import lie_algebra, metrics, sync
from evo.core.geometry import GeometryException
from evo.core.trajectory import PoseTrajectory3D

from aim_slam_ros.types import StampedPoses

MIN_POSES = 3
_MAX_DIFF_S = 0.02   # the association tolerance of the TUM tools
_MIN_DIFF_S = 0.01


@dataclass(frozen=True)
class TrajectoryError:
    """An estimate after its Sim(3) alignment to the ground truth.

    ate_rmse_m: root mean square of the absolute position errors, over the matched poses.
    scale: metres per unit of the estimate. T_reference_estimate: [4,4] float64, Sim(3), brings
    points of the estimate's world into the ground truth's. aligned, reference: the matched
    poses, metres; their stamps differ by the association tolerance at most. errors_m: [matched].
    """

    ate_rmse_m: float
    scale: float
    T_reference_estimate: np.ndarray
    aligned: StampedPoses
    reference: StampedPoses
    errors_m: np.ndarray

    @property
    def matched(self) -> int:
        return len(self.errors_m)


@dataclass(frozen=True)
class Incomparable:
    """Why there is no error to report."""

    reason: str


def compare(estimate: StampedPoses, groundtruth: StampedPoses) -> TrajectoryError | Incomparable:
    """Absolute trajectory error after Sim(3) alignment (Umeyama), stamps paired to the nearest."""
    if min(len(estimate), len(groundtruth)) < MIN_POSES:
        return Incomparable(f'{len(estimate)} estimated and {len(groundtruth)} true poses: '
                            f'at least {MIN_POSES} of each are needed')
    if not np.isfinite(estimate.T_world_cam).all():
        return Incomparable('the estimate holds non-finite poses')
    epoch_ns = int(groundtruth.stamps_ns[0])
    try:
        reference, aligned = sync.associate_trajectories(
            _to_evo(groundtruth, epoch_ns), _to_evo(estimate, epoch_ns),
            max_diff=tolerance_s(groundtruth))
    except sync.SyncException:
        return Incomparable('no pose is close enough in time to a pose of the ground truth')
    if aligned.num_poses < MIN_POSES:
        return Incomparable(f'only {aligned.num_poses} poses are close enough in time to the '
                            f'ground truth: at least {MIN_POSES} are needed')
    return _aligned_error(aligned, reference, epoch_ns)


def tolerance_s(groundtruth: StampedPoses) -> float:
    """How far apart in time two poses may be to count as one.

    Half the ground truth's spacing, so that an image in a gap of it is left out rather than
    paired with its neighbour's pose; never below the jitter of a recording, nor above TUM's.
    """
    spacing = float(np.median(np.diff(groundtruth.stamps_ns))) / 1e9
    return min(_MAX_DIFF_S, max(_MIN_DIFF_S, spacing / 2.0))


def during(poses: StampedPoses, first_ns: int, last_ns: int) -> StampedPoses:
    """The poses of a time span, both ends included."""
    inside = (poses.stamps_ns >= first_ns) & (poses.stamps_ns <= last_ns)
    return StampedPoses(poses.stamps_ns[inside], poses.T_world_cam[inside])


def length(poses: StampedPoses) -> float:
    """Arc length, in the poses' unit."""
    positions = poses.T_world_cam[:, :3, 3]
    return float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())


def _aligned_error(estimate: PoseTrajectory3D, reference: PoseTrajectory3D,
                   epoch_ns: int) -> TrajectoryError | Incomparable:
    """The error of associated poses; changes ``estimate``."""
    # evo tells a degenerate path by an absolute threshold: a monocular unit must not decide that
    extent = float(np.std(estimate.positions_xyz, axis=0).max())
    if not extent > 0.0:
        return Incomparable('the estimated camera never moved: its scale is unknown')
    estimate.scale(1.0 / extent)
    try:
        R, t, scale = estimate.align(reference, correct_scale=True)
    except GeometryException:
        return Incomparable('the camera moved along a line or not at all: the alignment to the '
                            'ground truth is not determined')
    error = metrics.APE(metrics.PoseRelation.translation_part)
    error.process_data((reference, estimate))
    return TrajectoryError(
        ate_rmse_m=float(error.get_statistic(metrics.StatisticsType.rmse)),
        scale=float(scale / extent),
        T_reference_estimate=lie_algebra.sim3(R, t, scale / extent),
        aligned=_from_evo(estimate, epoch_ns), reference=_from_evo(reference, epoch_ns),
        errors_m=np.asarray(error.error, np.float64))


def _to_evo(poses: StampedPoses, epoch_ns: int) -> PoseTrajectory3D:
    """Seconds since the epoch: as seconds since 1970 a float64 is only good to 0.2 us."""
    return PoseTrajectory3D(poses_se3=list(poses.T_world_cam.astype(np.float64)),
                            timestamps=(poses.stamps_ns - epoch_ns) / 1e9)


def _from_evo(trajectory: PoseTrajectory3D, epoch_ns: int) -> StampedPoses:
    stamps_ns = np.round(trajectory.timestamps * 1e9).astype(np.int64) + epoch_ns
    return StampedPoses(stamps_ns, np.stack(trajectory.poses_se3))
