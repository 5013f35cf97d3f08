"""The image and camera_info subscriptions of the frontend."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any, Callable

import numpy as np
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from msg_adapters.encodings import (K_from_camera_info, has_distortion, is_rectified,
                                    published_size)
from msg_adapters.errors import MessageError

from .parameters import FrontendParameters

_CAMERA_INFO_S = 2.0    # images without it for so long are said
_LOOK_S = 0.2    # how often it is looked whether something is amiss


@dataclass(frozen=True)
class ArrivedImage:
    """A message as it came. arrived_s: time.monotonic()."""

    message: Any
    arrived_s: float


def image_topic(parameters: FrontendParameters) -> str:
    """Before remapping."""
    return 'image/compressed' if parameters.image_transport == 'compressed' else 'image'


class ImageInput:
    """Hands every image on at once; says what is wrong while none come."""

    def __init__(self, node: Node, parameters: FrontendParameters,
                 on_image: Callable[[ArrivedImage], None]) -> None:
        self._node = node
        self._parameters = parameters
        self._on_image = on_image
        self._compressed = parameters.image_transport == 'compressed'
        self._topic = image_topic(parameters)
        self._switch = False
        self._last_s = time.monotonic()
        self._silent, self._said = False, ''
        self._subscribe(parameters.image_reliability != 'best_effort')
        node.create_timer(_LOOK_S, self._look, clock=Clock(clock_type=ClockType.STEADY_TIME))

    @property
    def topic(self) -> str:
        """Its full name."""
        return str(self._subscription.topic_name)

    @property
    def silent(self) -> bool:
        """Whether no image has come for longer than allowed."""
        return self._silent

    def _subscribe(self, reliable: bool) -> None:
        """Depth 1: the newest image is the only one worth having."""
        quality = QoSProfile(
            history=HistoryPolicy.KEEP_LAST, depth=1,
            reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT)
        self._subscription = self._node.create_subscription(
            CompressedImage if self._compressed else Image, self._topic, self._take, quality,
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=self._incompatible),
            qos_overriding_options=QoSOverridingOptions(
                [QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH]))

    def _take(self, message: Any) -> None:
        self._last_s = time.monotonic()
        self._on_image(ArrivedImage(message, self._last_s))

    def _incompatible(self, event: Any) -> None:
        if self._parameters.image_reliability == 'auto':
            self._switch = True     # not from within the subscription's own callback
            return
        self._node.get_logger().error(
            f'the publisher of {self._subscription.topic_name} offers best effort, which a '
            'reliable subscription does not match: no image will come; set the parameter '
            'image_reliability to auto or best_effort')

    def _look(self) -> None:
        if self._switch:
            self._switch = False
            self._node.destroy_subscription(self._subscription)
            self._subscribe(reliable=False)
            self._node.get_logger().info(
                f'{self._subscription.topic_name} is published as best effort and is taken so; '
                'if images are lost on the way, give Fast DDS more shared memory '
                '(config/fastdds_shm.xml)')
        waited_s = time.monotonic() - self._last_s
        self._silent = waited_s >= self._parameters.image_timeout_s
        if not self._silent:
            self._said = ''
            return
        why = self._why()
        if why != self._said:   # once, and again when there is news
            self._said = why
            self._node.get_logger().warning(f'no image for {waited_s:.1f} s; {why}')

    def _why(self) -> str:
        topic = self._subscription.topic_name
        if self._node.count_publishers(topic):
            return f'{topic} has a publisher that sends nothing (or nothing that arrives)'
        kinds = ['sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage']
        wanted, other = reversed(kinds) if self._compressed else kinds
        found, others = self._published(wanted), self._published(other)
        if found:
            there = f'{wanted} is published on {", ".join(found)}: remap with --ros-args ' \
                f'-r {self._topic}:={found[0]}'
        elif others:
            transport, name = ('raw', 'image') if self._compressed else (
                'compressed', 'image/compressed')
            there = f'only {other} is published, on {", ".join(others)}: take it with ' \
                f'--ros-args -p image_transport:={transport} -r {name}:={others[0]}'
        else:
            there = f'nobody publishes {wanted}: start a camera driver or play a bag'
        return f'nobody publishes {topic}; {there}'

    def _published(self, kind: str) -> list[str]:
        """Other topics of this type that somebody publishes."""
        return sorted(name for name, types in self._node.get_topic_names_and_types()
                      if kind in types and name != self._subscription.topic_name
                      and self._node.count_publishers(name))


class CameraInfoInput:
    """The camera's intrinsics, where camera_info tells usable ones."""

    def __init__(self, node: Node, used: bool, image_topic: str) -> None:
        """used: whether the settings ask for the calibration. image_topic: whose it is."""
        self._node = node
        self._used = used
        self._image_topic = image_topic
        self._said: set[str] = set()
        self._came = False
        self._K: np.ndarray | None = None
        self._size = (0, 0)
        self._begun_s: float | None = None
        # Best effort matches every publisher, and one that is lost comes again.
        self._subscription = node.create_subscription(
            CameraInfo, 'camera_info', self._take,
            QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT),
            qos_overriding_options=QoSOverridingOptions.with_default_policies())

    def K(self, width: int, height: int) -> np.ndarray | None:
        """[3,3] pixels of an image of this size; None where the camera is uncalibrated."""
        if self._used and not self._came:
            self._say_that_none_comes()
        if self._K is not None and self._size not in ((width, height), (0, 0)):
            self._say(f'camera_info is for images of {self._size[0]}x{self._size[1]} pixels, '
                      f'these have {width}x{height}: it is not used')
            return None
        return self._K

    def _say_that_none_comes(self) -> None:
        now = time.monotonic()
        self._begun_s = now if self._begun_s is None else self._begun_s
        if now - self._begun_s > _CAMERA_INFO_S:
            self._say(f'camera.use_calibration is set, but nothing comes on '
                      f'{self._subscription.topic_name}: the focal length is guessed; remap with '
                      '--ros-args -r camera_info:=TOPIC, or call ~/reset once it comes')

    def _take(self, message: CameraInfo) -> None:
        self._came = True
        try:
            rectified = is_rectified(self._image_topic, message)
            self._K = K_from_camera_info(message, rectified)
        except MessageError as error:
            self._K = None
            self._say(f'camera_info is not used: {error}')
            return
        self._size = published_size(message)
        if self._K is not None and not self._used:
            self._say('camera_info has a calibration; it is used when camera.use_calibration is '
                      'set', warn=False)
        if self._used and has_distortion(message) and not rectified:
            self._say('the images are distorted and are used as they are: subscribe to rectified '
                      'ones (image_proc) where the distortion is strong')

    def _say(self, text: str, warn: bool = True) -> None:
        """Once."""
        if text not in self._said:
            self._said.add(text)
            logger = self._node.get_logger()
            if warn:
                logger.warning(text)
            else:
                logger.info(text)
