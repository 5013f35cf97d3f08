"""Messages as they are written into bags, made without ROS."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import torch

from aim_slam_ros.datasets.bags import STORE
from aim_slam_ros.datasets.base import Calibration
from aim_slam_ros.geometry import sim3

CAMERA_FRAME = 'camera_optical_frame'
WORLD_FRAME = 'world'
_JPEG_QUALITY = 95
_PLUMB_BOB = 5      # k1 k2 p1 p2 k3; with more coefficients the model has another name


def image(rgb: np.ndarray, stamp_ns: int) -> Any:
    """rgb: [H,W,3] uint8. sensor_msgs/Image, mono8 where the picture is grey, else rgb8."""
    grey = _is_grey(rgb)
    pixels = np.ascontiguousarray(rgb[..., 0] if grey else rgb)
    height, width = pixels.shape[:2]
    return _make('sensor_msgs/msg/Image', header=_header(stamp_ns, CAMERA_FRAME), height=height,
                 width=width, encoding='mono8' if grey else 'rgb8', is_bigendian=0,
                 step=pixels.strides[0], data=pixels.reshape(-1))


def compressed(rgb: np.ndarray, stamp_ns: int) -> Any:
    """rgb: [H,W,3] uint8. sensor_msgs/CompressedImage, as JPEG."""
    pixels = rgb[..., 0] if _is_grey(rgb) else rgb[..., ::-1]
    jpeg = cv2.imencode('.jpg', pixels, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1]
    return _make('sensor_msgs/msg/CompressedImage', header=_header(stamp_ns, CAMERA_FRAME),
                 format='jpeg', data=jpeg.reshape(-1))


def camera_info(calibration: Calibration, width: int, height: int, stamp_ns: int) -> Any:
    """sensor_msgs/CameraInfo of images of this size."""
    given = calibration.distortion
    d = np.zeros(_PLUMB_BOB if given is None else max(len(given), _PLUMB_BOB))
    d[:0 if given is None else len(given)] = () if given is None else given
    K = calibration.K
    whole = _make('sensor_msgs/msg/RegionOfInterest', x_offset=0, y_offset=0, height=0, width=0,
                  do_rectify=False)
    return _make('sensor_msgs/msg/CameraInfo', header=_header(stamp_ns, CAMERA_FRAME),
                 height=height, width=width,
                 distortion_model='plumb_bob' if len(d) == _PLUMB_BOB else 'rational_polynomial',
                 d=d, k=K.reshape(-1), r=np.eye(3).reshape(-1),
                 p=np.hstack([K, np.zeros((3, 1))]).reshape(-1), binning_x=0, binning_y=0,
                 roi=whole)


def pose(T_world_cam: np.ndarray, stamp_ns: int) -> Any:
    """T_world_cam: [4,4], rigid. geometry_msgs/PoseStamped of the camera's optical frame."""
    T = torch.from_numpy(T_world_cam)
    x, y, z = sim3.translation_of(T).tolist()
    qx, qy, qz, qw = sim3.quaternion_of(sim3.rotation_of(T)).tolist()
    return _make('geometry_msgs/msg/PoseStamped', header=_header(stamp_ns, WORLD_FRAME),
                 pose=_make('geometry_msgs/msg/Pose',
                            position=_make('geometry_msgs/msg/Point', x=x, y=y, z=z),
                            orientation=_make('geometry_msgs/msg/Quaternion',
                                              x=qx, y=qy, z=qz, w=qw)))


def _header(stamp_ns: int, frame_id: str) -> Any:
    sec, nanosec = divmod(stamp_ns, 1_000_000_000)
    return _make('std_msgs/msg/Header', frame_id=frame_id,
                 stamp=_make('builtin_interfaces/msg/Time', sec=sec, nanosec=nanosec))


def _make(msgtype: str, **values: Any) -> Any:
    return STORE.types[msgtype](**values)


def _is_grey(rgb: np.ndarray) -> bool:
    # A few pixels tell for most pictures.
    few = rgb[::16, ::16]
    return all(np.array_equal(part[..., 0], part[..., channel])
               for part in (few, rgb) for channel in (1, 2))
