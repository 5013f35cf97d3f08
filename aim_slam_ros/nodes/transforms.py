"""TF, where it is installed: tf2_ros is no part of the ROS 2 wheels of the package index."""

from __future__ import annotations

from typing import Any

import torch
from rclpy.node import Node
from rclpy.time import Time
from torch import Tensor

from msg_adapters import poses

from ..geometry import sim3

try:
    import tf2_ros
except ImportError:
    tf2_ros = None


class Transforms:
    """Broadcasts and looks up rigid transforms; without tf2_ros it does neither."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._broadcaster: Any = None
        self._buffer: Any = None
        self._listener: Any = None
        self._said = False

    @property
    def available(self) -> bool:
        """Whether tf2_ros can be imported."""
        return tf2_ros is not None

    def send(self, T_parent_child: Tensor, stamp_ns: int, parent: str, child: str) -> None:
        """Broadcast; where TF is not installed, nothing, and that is said once."""
        if not self._usable():
            return
        if self._broadcaster is None:
            self._broadcaster = tf2_ros.TransformBroadcaster(self._node)
        self._broadcaster.sendTransform(poses.transform(T_parent_child, stamp_ns, parent, child))

    def listen(self) -> None:
        """Begin to collect what others broadcast."""
        if self._usable() and self._buffer is None:
            self._buffer = tf2_ros.Buffer()
            self._listener = tf2_ros.TransformListener(self._buffer, self._node)

    def lookup(self, parent: str, child: str) -> Tensor | None:
        """The newest T_parent_child [4,4] float64; None while TF does not know it.

        Only what was broadcast since ``listen`` is known, and before that for ever.
        """
        if self._buffer is None:
            return None
        try:
            found = self._buffer.lookup_transform(parent, child, Time()).transform
        except tf2_ros.TransformException:
            return None
        t, q = found.translation, found.rotation
        rotation = sim3.rotation_from_quaternion(torch.tensor([q.x, q.y, q.z, q.w]).double())
        return sim3.from_parts(1.0, rotation, torch.tensor([t.x, t.y, t.z]).double())

    def _usable(self) -> bool:
        if not self.available and not self._said:
            self._said = True
            self._node.get_logger().warning(
                'tf2_ros is not installed: no transforms are broadcast or looked up; install '
                'ros-jazzy-tf2-ros-py, or set publish_tf to false to silence this')
        return self.available
