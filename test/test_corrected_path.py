"""The path follows its keyframes, in time order, whatever comes late or twice."""

from __future__ import annotations

import time

import numpy as np
import torch
from torch import Tensor

from aim_slam_ros.geometry import sim3
from aim_slam_ros.loop_closure.corrected_path import CorrectedPath


def at(x: float, scale: float = 1.0) -> Tensor:
    return sim3.from_parts(scale, torch.eye(3), torch.tensor([x, 0.0, 0.0]))


def path_of(*frames: tuple[int, int, float]) -> CorrectedPath:
    """Frames (stamp, reference, x in the keyframe's unit)."""
    path = CorrectedPath()
    for stamp_ns, reference_id, x in frames:
        path.add(stamp_ns, reference_id, at(x))
    return path


def test_a_frame_follows_its_keyframe_and_stays_rigid() -> None:
    """One keyframe unit ahead of a keyframe at 10 with scale 2 is 12."""
    path = path_of((5, 0, 1.0))
    for T_world_kf, x in ((at(10.0, 2.0), 12.0), (at(-3.0), -2.0)):
        poses = path.poses({0: T_world_kf}, {0: 0})
        assert poses.stamps_ns.tolist() == [5]
        np.testing.assert_allclose(poses.T_world_cam[0], at(x).numpy(), atol=1e-12)


def test_late_frames_are_put_in_their_place() -> None:
    poses = path_of((30, 1, 0.3), (10, 0, 0.1), (20, 1, 0.2)).poses(
        {0: at(0.0), 1: at(1.0)}, {0: 0, 1: 0})
    assert poses.stamps_ns.tolist() == [10, 20, 30]
    np.testing.assert_allclose(poses.T_world_cam[:, 0, 3], [0.1, 1.2, 1.3])


def test_a_later_word_on_a_frame_replaces_the_earlier() -> None:
    path = path_of((10, 0, 0.1), (20, 0, 0.2), (10, 1, 0.5))
    poses = path.poses({0: at(0.0), 1: at(1.0)}, {0: 0, 1: 0})
    assert len(path) == 2
    np.testing.assert_allclose(poses.T_world_cam[:, 0, 3], [1.5, 0.2])


def test_only_the_largest_piece_is_a_path() -> None:
    path = path_of((10, 0, 0.0), (20, 1, 0.0), (30, 2, 0.0))
    known = {0: at(0.0), 1: at(0.0), 2: at(0.0)}
    assert path.poses(known, {0: 0, 1: 1, 2: 1}).stamps_ns.tolist() == [20, 30]
    assert path.largest_piece({0: 0, 1: 1, 2: 1}) == 1
    joined = path.poses(known, {0: 0, 1: 0, 2: 0})
    assert joined.stamps_ns.tolist() == [10, 20, 30], 'a loop has joined them'


def test_a_frame_waits_for_its_keyframe() -> None:
    path = path_of((10, 0, 0.0), (20, 7, 0.0))
    assert path.poses({0: at(0.0)}, {0: 0}).stamps_ns.tolist() == [10]
    assert path.poses({0: at(0.0), 7: at(1.0)}, {0: 0, 7: 0}).stamps_ns.tolist() == [10, 20]


def test_nothing_is_a_path_too() -> None:
    assert len(CorrectedPath().poses({}, {})) == 0
    assert len(path_of((10, 0, 0.0)).poses({}, {})) == 0
    assert CorrectedPath().largest_piece({}) is None


def test_a_long_path_takes_no_time() -> None:
    """20000 frames: ten minutes at 30 Hz. Python loops would take a second."""
    path = CorrectedPath()
    for k in range(20000):
        path.add(k, k // 40, at(0.001 * k))
    T_world_kf = {k: at(float(k), 1.5) for k in range(500)}
    pieces = dict.fromkeys(T_world_kf, 0)
    costs_s = []
    for _ in range(5):
        start = time.perf_counter()
        poses = path.poses(T_world_kf, pieces)
        costs_s.append(time.perf_counter() - start)
    assert len(poses) == 20000
    assert min(costs_s) < 0.1       # 20 ms on an idle machine
