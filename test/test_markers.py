"""The pose graph as markers over real serialisation."""

from __future__ import annotations

import torch
from visualization_msgs.msg import Marker
from wire import over_wire

from aim_slam_ros.geometry import sim3
from aim_slam_ros.types import KeyframePose
from msg_adapters.markers import pose_graph_markers
from msg_adapters.stamps import stamp_ns

STAMP = 1_305_031_102_175_304_001


def _pose(keyframe_id: int) -> KeyframePose:
    """Keyframes in a row ahead of the first camera, one unit apart."""
    T = sim3.from_parts(0.5, torch.eye(3), torch.tensor([0.0, 0.0, float(keyframe_id)]))
    return KeyframePose(keyframe_id, T)


def _markers(ids: list[int], edges: list[tuple[int, int]],
             loops: list[tuple[int, int]]) -> dict[str, Marker]:
    poses = [_pose(i) for i in ids]
    found = over_wire(pose_graph_markers(poses, edges, loops, STAMP, 'map')).markers
    return {marker.ns: marker for marker in found}


def _x(marker: Marker) -> list[float]:
    return [point.x for point in marker.points]


def test_keyframes_edges_and_loops_in_the_z_up_map() -> None:
    markers = _markers([2, 3, 5], [(2, 3), (3, 5)], [(5, 2)])
    assert list(markers) == ['keyframes', 'edges', 'loops']
    assert _x(markers['keyframes']) == [2, 3, 5]
    assert _x(markers['edges']) == [2, 3, 3, 5]
    assert _x(markers['loops']) == [5, 2]
    for marker in markers.values():
        assert all(point.y == point.z == 0 for point in marker.points)
        assert (stamp_ns(marker.header.stamp), marker.header.frame_id) == (STAMP, 'map')
        assert marker.action == Marker.ADD and marker.pose.orientation.w == 1
        assert 0 < marker.scale.x < 1 and marker.color.a > 0


def test_an_edge_to_an_unknown_keyframe_is_left_out() -> None:
    markers = _markers([2, 3], [(2, 3), (3, 4)], [])
    assert _x(markers['edges']) == [2, 3]


def test_what_is_gone_is_taken_away() -> None:
    """After a reset the old graph must not stay on the screen."""
    markers = _markers([], [], [])
    assert {marker.action for marker in markers.values()} == {Marker.DELETE}
    assert _markers([1], [], [])['keyframes'].action == Marker.ADD


def test_one_keyframe_has_a_size() -> None:
    assert _markers([1], [], [])['keyframes'].scale.x > 0
