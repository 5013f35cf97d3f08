"""A bag player for machines without rosbag2, and for those who must know what was sent when.

Topics are published by relative names: those of the bag without their leading slash, so that
the node's namespace and remappings apply. Topics of which a system has one keep their absolute
names (/tf, /clock, ...). All are reliable with a depth of 10; what was recorded as latched
(transient local) is so again.
"""

from __future__ import annotations

import importlib
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Callable

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock

from msg_adapters.stamps import stamp_msg

from ...datasets.bag_topics import COMPRESSED, IMAGE
from ...datasets.bags import Bag, BagMessage, BagTopic, header_stamp_ns
from .pace import Pace
from .read_ahead import ReadAhead
from .subscribers import wait_for_subscriber, what_is_subscribed

_IMAGES = (IMAGE, COMPRESSED)
_ABSOLUTE = ('/tf', '/tf_static', '/clock', '/rosout', '/parameter_events')
_DEPTH = 10
_LATCHED_DEPTH = 100    # static transforms come in several messages, all of them wanted
_ACKED_S = 2.0
_SECOND_NS = 1_000_000_000
# A bag of a single message, looped, would keep a processor busy.
_SEAM_S = 0.001


class PlayError(Exception):
    """A bag that cannot be played as asked; says why and what to do."""


@dataclass(frozen=True)
class PlayOptions:
    """rate: times real time. start_offset_s, duration_s: of the bag's time. clock_hz: how often
    /clock is published; 0: never. topics: as the bag names them; empty: all."""

    rate: float = 1.0
    loop: bool = False
    start_offset_s: float = 0.0
    duration_s: float | None = None
    clock_hz: float = 0.0
    topics: tuple[str, ...] = ()


@dataclass(frozen=True)
class Published:
    """A message that has just been sent.

    topic: as the bag names it. is_image: it is an Image or CompressedImage. stamp_ns: that of
    its header for images, else the time of recording. monotonic_ns: time.monotonic_ns() when it
    was handed over; late_ns: how much later than due that was.
    """

    topic: str
    is_image: bool
    stamp_ns: int
    monotonic_ns: int
    late_ns: int


@dataclass
class Played:
    """What was sent. damaged: messages left out."""

    messages: int = 0
    images: int = 0
    damaged: int = 0
    late_max_ns: int = 0


class Player:
    """Publishes a bag through a node, which need not spin.

    image_topics: their names as published, remapped. images, messages: how many are sent in one
    round; length_s: how long it takes. left_out: topic to the reason why it is not published.
    """

    def __init__(self, node: Node, bag_path: Path, options: PlayOptions = PlayOptions()) -> None:
        """Raises DatasetError and PlayError."""
        self._node = node
        self._options = options
        self._bag = Bag(bag_path)
        self.left_out: dict[str, str] = {}
        self._types = self._playable()
        self._start_ns, self._stop_ns = self._window()
        self.images, self.messages = self._counts()
        self.length_s = (self._stop_ns - 1 - self._start_ns) / _SECOND_NS / options.rate
        self._publishers = {name: self._publisher(self._bag.topics[name], msgtype)
                            for name, msgtype in self._types.items()}
        self._clock = node.create_publisher(Clock, '/clock', _DEPTH) if options.clock_hz else None
        self._image_publishers = [publisher for name, publisher in self._publishers.items()
                                  if self._is_image(name)]
        self.image_topics = [publisher.topic_name for publisher in self._image_publishers]

    def wait_for_subscriber(self, timeout_s: float, stop: threading.Event | None = None) -> None:
        """Until somebody listens to an image topic; PlayError where nobody does in time."""
        stop = stop or threading.Event()
        publishers = self._image_publishers
        if wait_for_subscriber(publishers, timeout_s, stop) or stop.is_set():
            return
        raise PlayError(
            f'nobody has subscribed to {" or ".join(self.image_topics)} within {timeout_s:g} s; '
            f'{what_is_subscribed(self._node, publishers, _IMAGES)}; start the node that takes '
            'the images, or remap one of the two topics: --ros-args -r image:=NAME')

    def play(self, on_published: Callable[[Published], object] = lambda published: None,
             stop: threading.Event | None = None) -> Played:
        """One round, or rounds without end, until ``stop`` is set. Times and stamps go back where
        a round begins. Raises DatasetError where the bag is damaged."""
        stop = stop or threading.Event()
        played = Played()
        self._round(played, on_published, stop)
        while self._options.loop and not stop.wait(_SEAM_S):
            self._round(played, on_published, stop)
        if not stop.is_set():
            self._wait_until_received()
        return played

    def close(self) -> None:
        """Withdraw the topics and close the bag."""
        for publisher in [*self._publishers.values(), *([self._clock] if self._clock else [])]:
            self._node.destroy_publisher(publisher)
        self._bag.close()

    def _round(self, played: Played, on_published: Callable[[Published], object],
               stop: threading.Event) -> None:
        coming = ReadAhead(self._bag.messages(self._types, self._start_ns, self._stop_ns))
        options = self._options
        pace = Pace(self._start_ns, options.rate, options.clock_hz, self._tick, stop)
        try:
            for message in coming:
                late_ns = pace.wait_for(message.log_ns)
                if stop.is_set():
                    return
                self._send(message, late_ns, played, on_published)
        finally:
            coming.close()

    def _send(self, message: BagMessage, late_ns: int, played: Played,
              on_published: Callable[[Published], object]) -> None:
        if message.cdr is None:
            played.damaged += 1
            return
        is_image = self._is_image(message.topic)
        now_ns = time.monotonic_ns()
        self._publishers[message.topic].publish(message.cdr)
        played.messages += 1
        played.images += is_image
        played.late_max_ns = max(played.late_max_ns, late_ns)
        stamp_ns = header_stamp_ns(message.cdr) if is_image else None
        on_published(Published(message.topic, is_image,
                               message.log_ns if stamp_ns is None else stamp_ns, now_ns, late_ns))

    def _tick(self, bag_ns: int) -> None:
        if self._clock is not None:
            self._clock.publish(Clock(clock=stamp_msg(bag_ns)))

    def _wait_until_received(self) -> None:
        """A publisher that goes takes what it has not yet delivered with it."""
        deadline_s = time.monotonic() + _ACKED_S
        for publisher in self._publishers.values():
            left_s = max(deadline_s - time.monotonic(), 0.0)
            publisher.wait_for_all_acked(Duration(seconds=left_s))

    def _is_image(self, topic: str) -> bool:
        return self._bag.topics[topic].msgtype in _IMAGES

    def _playable(self) -> dict[str, Any]:
        """Topic to its message class; fills left_out."""
        wanted, there = [name.strip('/') for name in self._options.topics], self._bag.topics
        unknown = set(wanted) - {name.strip('/') for name in there}
        if unknown:
            raise PlayError(f'{self._bag.path} has no topic {", ".join(sorted(unknown))}; name '
                            f'some of {", ".join(there)}')
        types = {}
        for name, topic in there.items():
            if wanted and name.strip('/') not in wanted:
                continue
            msgtype = _message_type(topic.msgtype)
            if name == '/clock' and self._options.clock_hz:
                self.left_out[name] = 'the player publishes its own'
            elif msgtype is None:
                self.left_out[name] = f'its type {topic.msgtype} is not installed'
            elif not topic.conforms:
                self.left_out[name] = f'its {topic.msgtype} is another than that of ROS 2 Jazzy'
            else:
                types[name] = msgtype
        if not types:
            reasons = '; '.join(f'{name}: {why}' for name, why in self.left_out.items())
            raise PlayError(f'{self._bag.path} has nothing that can be played ({reasons}); '
                            'install the packages of these types')
        return types

    def _window(self) -> tuple[int, int]:
        """First time to play, and the first one not to play any more."""
        bag, options = self._bag, self._options
        start_ns = bag.start_ns + round(options.start_offset_s * _SECOND_NS)
        if start_ns > bag.end_ns:
            raise PlayError(f'the start offset of {options.start_offset_s:g} s is beyond the end: '
                            f'{bag.path} is {(bag.end_ns - bag.start_ns) / _SECOND_NS:.1f} s long')
        if options.duration_s is None:
            return start_ns, bag.end_ns + 1
        return start_ns, min(start_ns + round(options.duration_s * _SECOND_NS), bag.end_ns) + 1

    def _counts(self) -> tuple[int, int]:
        """Images and messages of a round."""
        bag = self._bag
        if (self._start_ns, self._stop_ns) == (bag.start_ns, bag.end_ns + 1):
            counts = {name: bag.topics[name].count for name in self._types}
        else:
            counts = dict.fromkeys(self._types, 0)
            for message in bag.messages(self._types, self._start_ns, self._stop_ns):
                counts[message.topic] += 1
        if not sum(counts.values()):
            raise PlayError(f'{bag.path} has no message in this span of time; choose another '
                            'start offset or duration')
        return (sum(count for name, count in counts.items() if self._is_image(name)),
                sum(counts.values()))

    def _publisher(self, topic: BagTopic, msgtype: Any) -> Publisher:
        latched = topic.latched or topic.name == '/tf_static'
        qos = QoSProfile(
            depth=_LATCHED_DEPTH if latched else _DEPTH, reliability=ReliabilityPolicy.RELIABLE,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE)
        name = topic.name if topic.name in _ABSOLUTE else topic.name.removeprefix('/')
        return self._node.create_publisher(msgtype, name, qos)


def _message_type(name: str) -> Any | None:
    """'sensor_msgs/msg/Image' to its class; None where its package is not installed."""
    package, _, last = name.partition('/msg/')
    try:
        return getattr(importlib.import_module(f'{package}.msg'), last, None)
    except ModuleNotFoundError:
        return None
