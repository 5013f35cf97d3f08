"""What the frontend publishes."""

from __future__ import annotations

from typing import Any

import torch
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import PointCloud2
from torch import Tensor

from msg_adapters import clouds, frames, keyframes, poses

from ...frontend.concurrent import PlacedResult
from ...geometry import sim3
from ...types import FrameReport, KeyframeEvent
from ..transforms import Transforms
from .parameters import FrontendParameters

_NO_FRAME = 'camera_optical_frame'


class FrontendOutput:
    """Publishers of the frontend; safe to call from its worker thread."""

    def __init__(self, node: Node, parameters: FrontendParameters) -> None:
        self._node = node
        self._parameters = parameters
        self._pose = self._publisher(PoseStamped, 'pose', 10)
        self._odometry = self._publisher(Odometry, 'odometry', 10)
        self._points = self._publisher(PointCloud2, 'points', 1)
        self._frame = self._publisher(PointCloud2, 'frame', 100)
        self._keyframe = self._publisher(PointCloud2, 'keyframe', 20)
        self._keyframe_cloud = self._publisher(PointCloud2, 'keyframe_cloud', 20)
        self._transforms = Transforms(node)
        if parameters.base_frame:
            self._transforms.listen()
        self._base_unknown = False
        self._last_ns = -1
        self.camera_frame = parameters.camera_frame or _NO_FRAME

    def saw_frame_id(self, frame_id: str) -> None:
        """The frame_id of an image names the camera, unless a parameter does."""
        if frame_id and not self._parameters.camera_frame:
            self.camera_frame = frame_id

    def restart(self) -> None:
        """Time may begin again."""
        self._last_ns = -1

    def publish(self, placed: PlacedResult, session_id: int, dropped: int) -> bool:
        """One result with its keyframes; whether a pose of it went out.

        Poses leave in the order of their stamps: what the model found out about an image that
        later ones have overtaken is told in ``frame`` alone.
        """
        report = FrameReport(session_id, placed.result, placed.T_odom_cam, dropped)
        posed = placed.T_odom_cam is not None and not placed.again \
            and placed.result.stamp_ns > self._last_ns
        if posed and placed.T_odom_cam is not None:
            self._last_ns = placed.result.stamp_ns
            self._publish_pose(placed.T_odom_cam, placed.result.stamp_ns)
        self._frame.publish(frames.frame_message(report, self._parameters.odom_frame))
        for event in placed.result.events:
            self.publish_event(event, session_id)
        if placed.result.events:
            self._publish_points(placed.result.events[-1], placed.T_odom_world)
        return posed

    def publish_event(self, event: KeyframeEvent, session_id: int) -> None:
        """For loop closure, where somebody listens: it asks again for what it missed."""
        if not (self._keyframe.get_subscription_count()
                or self._keyframe_cloud.get_subscription_count()):
            return
        messages = keyframes.keyframe_messages(event, session_id, self.camera_frame,
                                               self._parameters.map_frame)
        self._keyframe_cloud.publish(messages.cloud)
        self._keyframe.publish(messages.table)

    def _publish_pose(self, T_odom_cam: Tensor, stamp_ns: int) -> None:
        odom = self._parameters.odom_frame
        T_odom_camera = poses.T_ZUP_OPTICAL @ T_odom_cam
        self._pose.publish(poses.pose_stamped(T_odom_camera, stamp_ns, odom))
        found = self._child()
        if found is None:
            return
        T_camera_child, child = found
        T_odom_child = T_odom_camera @ T_camera_child
        self._odometry.publish(poses.odometry(T_odom_child, stamp_ns, odom, child))
        if self._parameters.publish_tf:
            self._transforms.send(T_odom_child, stamp_ns, odom, child)

    def _child(self) -> tuple[Tensor, str] | None:
        """The frame that odometry and TF are of, seen from the camera; None while it is unknown.

        The camera itself is no substitute: a robot's TF that once hears of its camera in odom
        forgets where on the robot it is.
        """
        base = self._parameters.base_frame
        if base and base != self.camera_frame:
            T_camera_base = self._transforms.lookup(self.camera_frame, base)
            if T_camera_base is not None:
                self._base_unknown = False
                return T_camera_base, base
            if not self._base_unknown:
                self._base_unknown = True
                self._node.get_logger().warning(
                    f'TF does not know {self.camera_frame} in {base}: there is no odometry and no '
                    'TF until it does; publish that transform (robot_state_publisher, '
                    'static_transform_publisher)')
            return None
        return sim3.identity(), self.camera_frame

    def _publish_points(self, event: KeyframeEvent, T_odom_world: Tensor) -> None:
        """The newest keyframe in the odom frame, every second pixel of what the model saw."""
        if not (self._parameters.publish_points and self._points.get_subscription_count()):
            return
        points, confidence = event.points_cam[::2, ::2], event.confidence[::2, ::2]
        seen = (confidence >= torch.median(confidence)) & points.isfinite().all(-1)
        T = poses.T_ZUP_OPTICAL @ T_odom_world @ event.T_world_kf
        self._points.publish(clouds.cloud_msg(
            sim3.transform(T, points[seen].double()).float().numpy(),
            event.image[::2, ::2][seen.numpy()], event.stamp_ns, self._parameters.odom_frame))

    def _publisher(self, kind: Any, topic: str, depth: int) -> Any:
        return self._node.create_publisher(
            kind, topic, QoSProfile(depth=depth),
            qos_overriding_options=QoSOverridingOptions.with_default_policies())
