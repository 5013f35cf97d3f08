"""The pose graph for RViz."""

from __future__ import annotations

from typing import Sequence

import numpy as np
import torch
from geometry_msgs.msg import Point
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from aim_slam_ros.types import KeyframePose

from .pose_columns import z_up
from .stamps import header

_KEYFRAMES = ColorRGBA(r=1.0, g=0.75, b=0.1, a=1.0)
_EDGES = ColorRGBA(r=0.3, g=0.6, b=1.0, a=0.8)
_LOOPS = ColorRGBA(r=1.0, g=0.2, b=0.3, a=1.0)
_SMALLEST = 1e-3   # RViz does not show what has no size


def pose_graph_markers(poses: Sequence[KeyframePose], edges: Sequence[tuple[int, int]],
                       loops: Sequence[tuple[int, int]], stamp_ns: int,
                       map_frame: str) -> MarkerArray:
    """Keyframes as points, edges and loops as lines between them, in the z-up map.

    edges, loops: pairs of keyframe ids; a pair with an id that has no pose is left out. Sizes
    follow the map's extent, since a monocular map has a unit of its own.
    """
    positions = z_up(torch.stack([pose.T_world_kf for pose in poses]))[:, :3, 3].numpy() \
        if poses else np.empty((0, 3))
    points = [Point(x=x, y=y, z=z) for x, y, z in positions.tolist()]
    extent = float(np.ptp(positions, axis=0).max()) if len(positions) else 0.0
    size = max(0.01 * extent, _SMALLEST)
    by_id = {pose.keyframe_id: point for pose, point in zip(poses, points)}
    markers = [
        _marker('keyframes', Marker.SPHERE_LIST, points, size, _KEYFRAMES),
        _marker('edges', Marker.LINE_LIST, _ends(edges, by_id), 0.2 * size, _EDGES),
        _marker('loops', Marker.LINE_LIST, _ends(loops, by_id), 0.4 * size, _LOOPS)]
    for marker in markers:
        marker.header = header(stamp_ns, map_frame)
    return MarkerArray(markers=markers)


def _ends(pairs: Sequence[tuple[int, int]], by_id: dict[int, Point]) -> list[Point]:
    return [by_id[i] for a, b in pairs if a in by_id and b in by_id for i in (a, b)]


def _marker(namespace: str, kind: int, points: list[Point], size: float,
            colour: ColorRGBA) -> Marker:
    """A marker without points takes the one shown before away: RViz warns about an empty list."""
    marker = Marker(ns=namespace, id=0, type=kind, points=points, color=colour,
                    action=Marker.ADD if points else Marker.DELETE)
    marker.scale.x = marker.scale.y = marker.scale.z = size
    marker.pose.orientation.w = 1.0
    return marker
