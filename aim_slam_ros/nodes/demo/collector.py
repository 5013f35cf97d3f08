"""Listens to both nodes and keeps what it hears, serialised, until somebody asks."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from typing import Any, Iterable

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry, Path
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

_DEPTH = 200        # so many messages may wait while the interpreter is busy elsewhere
_END_S = 2.0


@dataclass(frozen=True)
class Spec:
    """A topic: latched ones hold a whole state, of which only the newest is kept."""

    name: str
    kind: type
    latched: bool = False


# keyframe_cloud and points are left out: megabytes that would only be counted.
SPECS = (
    Spec('pose', PoseStamped), Spec('odometry', Odometry), Spec('frame', PointCloud2),
    Spec('keyframe', PointCloud2), Spec('corrected_pose', PoseStamped),
    Spec('keyframe_poses', PointCloud2, latched=True), Spec('path', Path, latched=True),
    Spec('map', PointCloud2, latched=True), Spec('pose_graph', MarkerArray, latched=True),
    Spec('/diagnostics', DiagnosticArray))


@dataclass(frozen=True)
class Heard:
    """A serialised message and when it came. arrival_ns: of time.monotonic_ns."""

    arrival_ns: int
    raw: bytes


class Topic:
    """What was heard on one topic; written by the listening thread, read by any."""

    def __init__(self, spec: Spec) -> None:
        self.spec = spec
        self.messages = 0
        self.size_bytes = 0
        self._heard: list[Heard] = []

    def take(self, raw: bytes) -> None:
        """The subscription's callback: short, since images are published beside it."""
        heard = Heard(time.monotonic_ns(), raw)
        self.messages += 1
        self.size_bytes += len(raw)
        if self.spec.latched:
            self._heard = [heard]
        else:
            self._heard.append(heard)

    @property
    def heard(self) -> tuple[Heard, ...]:
        """In the order of arrival; of a latched topic only the newest."""
        return tuple(self._heard)

    @property
    def newest(self) -> Heard | None:
        heard = self._heard
        return heard[-1] if heard else None

    def read(self, heard: Heard) -> Any:
        """The message."""
        return deserialize_message(heard.raw, self.spec.kind)

    def read_newest(self) -> Any:
        """The newest message; None before the first."""
        newest = self.newest
        return None if newest is None else self.read(newest)


class Collector:
    """A node in a thread of its own, which subscribes to every topic of SPECS."""

    def __init__(self) -> None:
        self._node = Node('collector')
        self.topics = {spec.name: self._listen(spec) for spec in SPECS}
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._spin, name='collector', daemon=True)
        self._thread.start()

    def missing(self, subscribed: Iterable[str]) -> list[str]:
        """Topics that nobody publishes yet, and those of ``subscribed`` without a subscriber."""
        return [f'published {name}' for name in self.topics
                if not self._node.count_publishers(name)] + [
            f'subscribed to {name}' for name in subscribed
            if not self._node.count_subscribers(name)]

    def close(self) -> None:
        """Stop listening; what was heard stays."""
        self._executor.shutdown(timeout_sec=_END_S)
        self._thread.join(_END_S)
        self._node.destroy_node()

    def _listen(self, spec: Spec) -> Topic:
        topic = Topic(spec)
        qos = QoSProfile(depth=1 if spec.latched else _DEPTH,
                         reliability=ReliabilityPolicy.RELIABLE,
                         durability=DurabilityPolicy.TRANSIENT_LOCAL if spec.latched
                         else DurabilityPolicy.VOLATILE)
        self._node.create_subscription(spec.kind, spec.name, topic.take, qos, raw=True)
        return topic

    def _spin(self) -> None:
        try:
            self._executor.spin()
        except ExternalShutdownException:
            pass        # rclpy was shut down first
