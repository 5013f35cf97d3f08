"""Where frames are in the map, while parts of it are not connected."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from torch import Tensor

from aim_slam_ros.config import Config, LoopClosureConfig
from aim_slam_ros.geometry import sim3
from aim_slam_ros.nodes.loop_closure import output
from aim_slam_ros.nodes.loop_closure.map_session import MapSession
from aim_slam_ros.types import FrameReport, FrameResult, StampedPoses, TrackingStatus
from room_walk import RoomModel, drifting_events

SECOND = 10 ** 9


def _session() -> MapSession:
    config = dataclasses.replace(Config(), loop_closure=LoopClosureConfig(enabled=False))
    return MapSession(1, config, RoomModel(), 1.0)


def _frame(stamp_ns: int, reference_id: int, T_odom_cam: Tensor) -> FrameReport:
    """At its keyframe."""
    result = FrameResult(stamp_ns, TrackingStatus.TRACKED, T_odom_cam, reference_id,
                         sim3.identity())
    return FrameReport(1, result, T_odom_cam, 0)


def _at(x: float) -> Tensor:
    T = sim3.identity()
    T[0, 3] = x
    return T


def test_a_camera_in_a_new_piece_goes_on_where_odometry_has_it() -> None:
    """Piece 0 has keyframes 0 to 2, and a camera that was lost comes back in piece 3."""
    session, events = _session(), drifting_events(0.0, piece_from=3)[:5]
    for k in range(3):
        session.add(events[k])
        for i in range(2):
            session.place(_frame(k * SECOND + i, k, sim3.rigid_part(events[k].T_world_kf)))
    last = sim3.rigid_part(events[2].T_world_kf)
    for k in (3, 4):
        session.add(events[k])
        T_odom_cam = last @ _at(0.1 * k)
        placed = session.place(_frame(k * SECOND, k, T_odom_cam))
        assert placed is not None and torch.allclose(placed, T_odom_cam, atol=1e-9)
    assert len(session.trajectory()) == 6, 'of the old piece, as its pose and its cloud are'
    assert len(session.keyframe_trajectory()) == 3 and session.pieces == 2
    cloud = len(session.cloud().points)
    for i in range(10):
        session.place(_frame(5 * SECOND + i, 4, last))
    session.add(dataclasses.replace(events[4], observations=2))
    assert len(session.trajectory()) == 12, 'until the new one is the larger part'
    assert len(session.keyframe_trajectory()) == 2 and len(session.cloud().points) != cloud
    placed = session.place(_frame(6 * SECOND, 4, last))
    assert placed is not None
    assert torch.allclose(placed, sim3.rigid_part(events[4].T_world_kf), atol=1e-9)


def test_a_long_path_is_thinned_and_ends_with_the_newest() -> None:
    for count in (1, output._PATH_POSES, output._PATH_POSES + 1, 10 ** 5 + 3):
        stamps = np.arange(count, dtype=np.int64)
        thinned = output._thinned(StampedPoses(stamps, np.tile(np.eye(4), (count, 1, 1))))
        assert len(thinned) == len(thinned.T_world_cam) <= output._PATH_POSES
        assert len(thinned) > output._PATH_POSES / 2 or count == 1
        assert thinned.stamps_ns[-1] == count - 1
        assert len(set(np.diff(thinned.stamps_ns))) <= 1, 'every n-th'
