"""Bags with known content, as other recorders write them."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Iterable

import numpy as np
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS2 = get_typestore(Stores.ROS2_JAZZY)
FIRST_NS = 1_700_000_000_123_456_789
STEP_NS = 100_000_000
Record = tuple[str, int, Any]       # topic, log time [ns], message


def make(store: Any, msgtype: str, **values: Any) -> Any:
    if msgtype == 'std_msgs/msg/Header' and store is ROS1:
        values['seq'] = 7
    return store.types[msgtype](**values)


def header(stamp_ns: int, store: Any = ROS2) -> Any:
    sec, nanosec = divmod(stamp_ns, 10**9)
    time = make(store, 'builtin_interfaces/msg/Time', sec=sec, nanosec=nanosec)
    return make(store, 'std_msgs/msg/Header', stamp=time, frame_id='lens')


def picture(value: int, height: int = 48, width: int = 64) -> np.ndarray:
    """[H,W,3] uint8 RGB: noise with a red level of its own."""
    image = np.random.default_rng(value).integers(0, 255, (height, width, 3), dtype=np.uint8)
    image[..., 0] = value
    return image


def image(pixels: np.ndarray, stamp_ns: int, encoding: str = 'rgb8', store: Any = ROS2) -> Any:
    height, width = pixels.shape[:2]
    return make(store, 'sensor_msgs/msg/Image', header=header(stamp_ns, store), height=height,
                width=width, encoding=encoding, is_bigendian=0, step=pixels.strides[0],
                data=pixels.reshape(-1).view(np.uint8))


def camera_info(K: np.ndarray, d: Iterable[float], stamp_ns: int, store: Any = ROS2,
                model: str = 'plumb_bob') -> Any:
    roi = make(store, 'sensor_msgs/msg/RegionOfInterest', x_offset=0, y_offset=0, height=0,
               width=0, do_rectify=False)
    values = {'d': np.array(list(d), np.float64), 'k': K.reshape(-1), 'r': np.zeros(9),
              'p': np.zeros(12)}
    if store is ROS1:
        values = {name.upper(): value for name, value in values.items()}
    return make(store, 'sensor_msgs/msg/CameraInfo', header=header(stamp_ns, store), height=48,
                width=64, distortion_model=model, binning_x=0, binning_y=0, roi=roi, **values)


def transform(position: tuple[float, float, float], xyzw: tuple[float, float, float, float],
              stamp_ns: int, store: Any = ROS2) -> Any:
    translation = make(store, 'geometry_msgs/msg/Vector3', **dict(zip('xyz', position)))
    rotation = make(store, 'geometry_msgs/msg/Quaternion', **dict(zip('xyzw', xyzw)))
    return make(store, 'geometry_msgs/msg/TransformStamped', header=header(stamp_ns, store),
                child_frame_id='lens', transform=make(
                    store, 'geometry_msgs/msg/Transform', translation=translation,
                    rotation=rotation))


def write_ros2(path: Path, records: Iterable[Record],
               storage: StoragePlugin = StoragePlugin.MCAP) -> Path:
    """A message that is bytes is written as it is, as an Image."""
    with Writer(path, version=9, storage_plugin=storage) as writer:
        connections: dict[str, Any] = {}
        for topic, log_ns, message in records:
            msgtype = getattr(message, '__msgtype__', 'sensor_msgs/msg/Image')
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, msgtype, typestore=ROS2)
            raw = message if isinstance(message, bytes) else ROS2.serialize_cdr(message, msgtype)
            writer.write(connections[topic], log_ns, raw)
    return path


def write_ros1(path: Path, records: Iterable[Record]) -> Path:
    with Ros1Writer(path) as writer:
        connections: dict[str, Any] = {}
        for topic, log_ns, message in records:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, message.__msgtype__,
                                                           typestore=ROS1)
            writer.write(connections[topic], log_ns,
                         ROS1.serialize_ros1(message, message.__msgtype__))
    return path


def images(count: int, topic: str = '/image', store: Any = ROS2,
           size: tuple[int, int] = (48, 64)) -> list[Record]:
    """Pictures 0 to count - 1 (of height and width ``size``), recorded 5 ms after their stamps."""
    stamps = [FIRST_NS + i * STEP_NS for i in range(count)]
    return [(topic, stamp + 5_000_000, image(picture(i, *size), stamp, store=store))
            for i, stamp in enumerate(stamps)]
