"""What the loop-closure node publishes, all in the map frame."""

from __future__ import annotations

from typing import Any

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import PointCloud2
from torch import Tensor
from visualization_msgs.msg import MarkerArray

from msg_adapters import clouds, keyframes, markers, poses
from msg_adapters.serialised_path import serialised_path

from ...geometry import sim3
from ...types import CorrectedKeyframes, StampedPoses
from ..transforms import Transforms
from .map_files import z_up, z_up_cloud
from .map_session import MapSession
from .parameters import LoopClosureParameters


_PATH_POSES = 10_000     # a message of .7 MB; a whole day would be 190


class LoopClosureOutput:
    """Publishers; poses come from the callbacks, all else from the worker thread."""

    def __init__(self, node: Node, parameters: LoopClosureParameters) -> None:
        self._node = node
        self._parameters = parameters
        # Images that waited for the map come all at once.
        self._corrected_pose = self._publisher(PoseStamped, 'corrected_pose',
                                               QoSProfile(depth=100))
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._keyframe_poses = self._publisher(PointCloud2, 'keyframe_poses', latched)
        self._path = self._publisher(Path, 'path', latched)
        self._map = self._publisher(PointCloud2, 'map', latched)
        self._pose_graph = self._publisher(MarkerArray, 'pose_graph', latched)
        self._transforms = Transforms(node)
        self._last_ns = -1

    def restart(self) -> None:
        """Time may begin again."""
        self._last_ns = -1

    def pose(self, T_map_cam: Tensor, T_odom_cam: Tensor, stamp_ns: int) -> None:
        """Both rigid, as the first camera's axes have them. One for each image, in their order:

        what the model adds to an image later is for the path.
        """
        if stamp_ns <= self._last_ns:
            return
        self._last_ns = stamp_ns
        T_map, T_odom = poses.T_ZUP_OPTICAL @ T_map_cam, poses.T_ZUP_OPTICAL @ T_odom_cam
        map_frame = self._parameters.map_frame
        self._corrected_pose.publish(poses.pose_stamped(T_map, stamp_ns, map_frame))
        if self._parameters.publish_tf:
            self._transforms.send(T_map @ sim3.inverse(T_odom), stamp_ns, map_frame,
                                  self._parameters.odom_frame)

    def correction(self, corrected: CorrectedKeyframes, session: MapSession) -> None:
        """All keyframes, for the frontend."""
        stamps_ns = session.stamps_ns
        self._keyframe_poses.publish(keyframes.correction_message(
            corrected, stamps_ns, session.session_id, self._parameters.map_frame,
            max(stamps_ns.values())))

    def path(self, session: MapSession) -> None:
        """Every image of the largest piece; of a long run every n-th, and the newest."""
        trajectory = z_up(_thinned(session.trajectory()))
        self._path.publish(serialised_path(trajectory.stamps_ns, trajectory.T_world_cam,
                                           self._parameters.map_frame))

    def map(self, session: MapSession) -> None:
        """The fused cloud and the pose graph."""
        stamp_ns = max(session.stamps_ns.values(), default=0)
        cloud = z_up_cloud(session.cloud())
        map_frame = self._parameters.map_frame
        self._map.publish(clouds.cloud_msg(cloud.points, cloud.colours, stamp_ns, map_frame))
        pipeline = session.pipeline
        loops = [(loop.older, loop.newer) for loop in pipeline.loops]
        self._pose_graph.publish(markers.pose_graph_markers(
            pipeline.poses, pipeline.edges, loops, stamp_ns, map_frame))

    def _publisher(self, kind: Any, topic: str, qos: QoSProfile) -> Any:
        return self._node.create_publisher(
            kind, topic, qos,
            qos_overriding_options=QoSOverridingOptions.with_default_policies())


def _thinned(trajectory: StampedPoses) -> StampedPoses:
    step = -(-len(trajectory) // _PATH_POSES)
    if step <= 1:
        return trajectory
    rows = slice((len(trajectory) - 1) % step, None, step)     # the newest is the last one
    return StampedPoses(trajectory.stamps_ns[rows], trajectory.T_world_cam[rows])
