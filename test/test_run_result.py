"""Trajectories and figures that follow from a run."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from aim_slam_ros.evaluation import metrics
from aim_slam_ros.evaluation.run_result import (LoopPair, PlacedKeyframe, RunResult,
                                                UnreadableImage)
from aim_slam_ros.evaluation.trajectory import Incomparable, compare
from aim_slam_ros.geometry import sim3
from aim_slam_ros.types import Cloud, FrameResult, StampedPoses, TrackingStatus

EMPTY_MAP = Cloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8))
NO_TRUTH = Incomparable('there is no ground truth')


def at(x: float, y: float = 0.0, scale: float = 1.0) -> torch.Tensor:
    return sim3.from_parts(scale, torch.eye(3), torch.tensor([x, y, 0.0]))


def tracked(stamp_ns: int, reference_id: int, T_kf_cam: torch.Tensor) -> FrameResult:
    return FrameResult(stamp_ns, TrackingStatus.TRACKED, T_world_cam=at(float(stamp_ns)),
                       reference_id=reference_id, T_kf_cam=T_kf_cam)


def run_of(results: list[FrameResult], keyframes: list[PlacedKeyframe],
           **changes: object) -> RunResult:
    values: dict[str, object] = dict(
        results=tuple(results), unreadable=(), offered=len(results), wall_s=2.0, stage_s={},
        keyframes=tuple(keyframes), loops=(), map_cloud=EMPTY_MAP, rotation_only_inferences=0,
        interrupted=False)
    return RunResult(**(values | changes))  # type: ignore[arg-type]


def test_final_pose_follows_its_keyframe_and_is_rigid() -> None:
    """A frame 1 keyframe unit ahead of a keyframe at x = 10 with scale 2 stands at x = 12."""
    run = run_of([tracked(5, 0, at(1.0))], [PlacedKeyframe(0, 0, 5, at(10.0, scale=2.0))])
    assert run.trajectory.stamps_ns.tolist() == [5]
    np.testing.assert_allclose(run.trajectory.T_world_cam[0], at(12.0).numpy(), atol=1e-12)
    np.testing.assert_allclose(run.causal_trajectory.T_world_cam[0], at(5.0).numpy())
    np.testing.assert_allclose(run.keyframe_trajectory.T_world_cam[0], at(10.0).numpy(),
                               atol=1e-12)


def test_only_the_largest_piece_counts() -> None:
    keyframes = [PlacedKeyframe(0, 0, 1, at(0.0)), PlacedKeyframe(1, 1, 2, at(0.0)),
                 PlacedKeyframe(2, 1, 4, at(0.0))]
    run = run_of([tracked(1, 0, at(0.0)), tracked(2, 1, at(0.0)),
                  FrameResult(3, TrackingStatus.LOST), tracked(4, 2, at(0.0))], keyframes)
    assert run.trajectory.stamps_ns.tolist() == [2, 4]
    assert run.keyframe_trajectory.stamps_ns.tolist() == [2, 4]
    figures = metrics.compute(run, None, NO_TRUTH)
    assert figures['frames_tracked'] == 2 and figures['tracked_percent'] == 50.0
    assert figures['frames_lost'] == 1 and figures['map_pieces'] == 2


def test_rates_with_and_without_the_model() -> None:
    run = run_of([tracked(n, 0, at(0.0)) for n in range(10)], [PlacedKeyframe(0, 0, 0, at(0.0))],
                 stage_s={'read': 0.2, 'infer': 0.6, 'encode': 0.4},
                 loops=(LoopPair(4, 0),), unreadable=(UnreadableImage('a.png', 'empty'),),
                 offered=11)
    figures = metrics.compute(run, None, NO_TRUTH)
    assert figures['rate_hz'] == pytest.approx(11 / 2.0)
    assert figures['rate_without_model_hz'] == pytest.approx(11 / 1.0)
    assert figures['stage_infer_ms_per_frame'] == pytest.approx(600 / 11)
    assert figures['frames_unreadable'] == 1 and figures['loops'] == 1


def test_errors_are_of_the_final_and_of_the_reported_poses() -> None:
    """The final path is the true one; the reported one runs along a line and has no error."""
    angles = np.linspace(0, 3, 30)
    keyframes = [PlacedKeyframe(n, 0, n * 10**8, at(np.cos(a), np.sin(a)))
                 for n, a in enumerate(angles)]
    run = run_of([tracked(k.stamp_ns, k.keyframe_id, at(0.0)) for k in keyframes], keyframes)
    truth = StampedPoses(run.trajectory.stamps_ns,
                         torch.stack([k.T_world_kf for k in keyframes]).numpy())
    figures = metrics.compute(run, truth, compare(run.trajectory, truth))
    assert figures['ate_rmse_m'] == pytest.approx(0.0, abs=1e-9)
    assert figures['ate_rmse_causal_m'] is None
    # chords of 3/29 rad are shorter than their arcs by 1 - angle^2/24
    assert figures['trajectory_length_m'] == pytest.approx(3.0, rel=1e-3)


def test_a_run_that_saw_nothing_has_figures_too(tmp_path: Path) -> None:
    figures = metrics.compute(run_of([], [], wall_s=0.0), None, NO_TRUTH)
    assert figures['frames_tracked'] == 0 and figures['ate_rmse_m'] is None
    assert figures['rate_hz'] is None and figures['mean_window'] is None
    metrics.write(tmp_path / 'metrics.json', figures | {'mean_kappa': float('nan')})
    text = (tmp_path / 'metrics.json').read_text(encoding='utf-8')
    assert 'NaN' not in text and json.loads(text)['mean_kappa'] is None
