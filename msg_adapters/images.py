"""Images and intrinsics as messages."""

from __future__ import annotations

from typing import Any, Sequence

import cv2
import numpy as np
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from .errors import MessageError
from .payload import data_of
from .stamps import header


def image_msg(rgb: np.ndarray, stamp_ns: int, frame_id: str) -> Image:
    """An rgb8 image without padding. rgb: [H,W,3] uint8."""
    height, width = _checked(rgb)
    msg = Image(check_fields=True)
    msg.header = header(stamp_ns, frame_id)
    msg.height, msg.width, msg.step = height, width, 3 * width
    msg.encoding = 'rgb8'
    msg.data = data_of(rgb)
    return msg


def compressed_msg(rgb: np.ndarray, stamp_ns: int, frame_id: str,
                   quality: int = 90) -> CompressedImage:
    """The image as JPEG. rgb: [H,W,3] uint8; quality: 1 to 100."""
    _checked(rgb)
    bgr = cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2BGR)
    _, encoded = cv2.imencode('.jpg', bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])
    msg = CompressedImage(check_fields=True)
    msg.header = header(stamp_ns, frame_id)
    msg.format = 'rgb8; jpeg compressed bgr8'   # as image_transport writes it
    msg.data = data_of(encoded)
    return msg


def _checked(rgb: np.ndarray) -> tuple[int, int]:
    if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8 or not rgb.size:
        raise MessageError(f'an image must be [H,W,3] uint8 RGB, not {rgb.shape} {rgb.dtype}')
    return rgb.shape[0], rgb.shape[1]


def camera_info_msg(K: Any, width: int, height: int, stamp_ns: int, frame_id: str,
                    distortion: Sequence[float] | None = None) -> CameraInfo:
    """K: [3,3], array or tensor, in pixels, or None for a camera that is not calibrated.

    distortion: coefficients of plumb_bob (5) or rational_polynomial (8); None: without.
    """
    msg = CameraInfo(check_fields=True)
    msg.header = header(stamp_ns, frame_id)
    msg.width, msg.height = width, height
    if K is None:
        return msg
    coefficients = [0.0] * 5 if distortion is None else [float(d) for d in distortion]
    msg.distortion_model = 'plumb_bob' if len(coefficients) <= 5 else 'rational_polynomial'
    msg.d = coefficients
    intrinsics = np.asarray(K, np.float64).reshape(3, 3).copy()   # the message keeps it
    msg.k = intrinsics.reshape(-1)
    msg.r = np.eye(3).reshape(-1)
    msg.p = np.hstack([intrinsics, np.zeros((3, 1))]).reshape(-1)
    return msg
