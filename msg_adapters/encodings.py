"""What the pixels and intrinsics of a message mean. Needs no ROS.

Works on everything that has the fields of sensor_msgs/Image, CompressedImage and CameraInfo: the
messages of rclpy and those that rosbags reads from ROS 1 and ROS 2 bags.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from .errors import MessageError
from .payload import bytes_of


@dataclass(frozen=True)
class _Layout:
    """channels per pixel, bytes per channel, and the OpenCV conversion to RGB (None: it is)."""

    channels: int
    sample_bytes: int
    conversion: int | None
    even_width: bool = False


# ROS names a Bayer pattern by its upper left 2x2 pixels, OpenCV by those one row and column on.
_BAYER = {'rggb': cv2.COLOR_BayerBG2RGB, 'bggr': cv2.COLOR_BayerRG2RGB,
          'gbrg': cv2.COLOR_BayerGR2RGB, 'grbg': cv2.COLOR_BayerGB2RGB}
_GREY = cv2.COLOR_GRAY2RGB
_UYVY = _Layout(2, 1, cv2.COLOR_YUV2RGB_UYVY, even_width=True)
_YUYV = _Layout(2, 1, cv2.COLOR_YUV2RGB_YUY2, even_width=True)

# Numbered types are read as cv_bridge reads them: three and four channels are BGR and BGRA.
_LAYOUTS = {
    'rgb8': _Layout(3, 1, None),
    'bgr8': _Layout(3, 1, cv2.COLOR_BGR2RGB),
    'rgba8': _Layout(4, 1, cv2.COLOR_RGBA2RGB),
    'bgra8': _Layout(4, 1, cv2.COLOR_BGRA2RGB),
    'mono8': _Layout(1, 1, _GREY),
    'mono16': _Layout(1, 2, _GREY),
    'rgb16': _Layout(3, 2, None),
    'bgr16': _Layout(3, 2, cv2.COLOR_BGR2RGB),
    'rgba16': _Layout(4, 2, cv2.COLOR_RGBA2RGB),
    'bgra16': _Layout(4, 2, cv2.COLOR_BGRA2RGB),
    '8UC1': _Layout(1, 1, _GREY),
    '8UC3': _Layout(3, 1, cv2.COLOR_BGR2RGB),
    '8UC4': _Layout(4, 1, cv2.COLOR_BGRA2RGB),
    '16UC1': _Layout(1, 2, _GREY),
    '16UC3': _Layout(3, 2, cv2.COLOR_BGR2RGB),
    **{f'bayer_{name}8': _Layout(1, 1, code) for name, code in _BAYER.items()},
    **{f'bayer_{name}16': _Layout(1, 2, code) for name, code in _BAYER.items()},
    'yuv422': _UYVY, 'uyvy': _UYVY,
    'yuv422_yuy2': _YUYV, 'yuyv': _YUYV,
}
ENCODINGS = tuple(_LAYOUTS)


def rgb_from_image(msg: Any) -> np.ndarray:
    """[H,W,3] uint8 RGB, contiguous, of a sensor_msgs/Image; raises MessageError.

    An rgb8 image without padding is not copied: the result shares the message's memory and may be
    read-only, so do not write into it. 16-bit samples keep their upper 8 bits.
    """
    layout = _LAYOUTS.get(msg.encoding)
    if layout is None:
        raise MessageError(f"unknown image encoding '{msg.encoding}': publish one of "
                           f'{", ".join(ENCODINGS)}')
    pixels = _pixels(msg, layout)
    if layout.sample_bytes == 2:
        pixels = (pixels >> 8).astype(np.uint8)
    if layout.conversion is None:
        return np.ascontiguousarray(pixels)
    return cv2.cvtColor(pixels, layout.conversion)


def _pixels(msg: Any, layout: _Layout) -> np.ndarray:
    """[H,W] or [H,W,C], a view of the message's bytes without the padding of its rows."""
    height, width, step = int(msg.height), int(msg.width), int(msg.step)
    data = bytes_of(msg.data) if len(msg.data) else np.zeros(0, np.uint8)
    _check_size(msg, layout, len(data))
    dtype = np.dtype(np.uint8) if layout.sample_bytes == 1 else \
        np.dtype('>u2' if msg.is_bigendian else '<u2')
    pixel_bytes = layout.channels * layout.sample_bytes
    view = np.ndarray((height, width, layout.channels), dtype, data,
                      strides=(step, pixel_bytes, layout.sample_bytes))
    return view[..., 0] if layout.channels == 1 else view


def _check_size(msg: Any, layout: _Layout, length: int) -> None:
    height, width, step = int(msg.height), int(msg.width), int(msg.step)
    row_bytes = width * layout.channels * layout.sample_bytes
    what = f'a {msg.encoding} image of {width}x{height}'
    if height < 1 or width < 1:
        raise MessageError(f'{what} has no pixels: check the camera driver')
    if step < row_bytes:
        raise MessageError(f'{what} has a step of {step} bytes, but a row takes {row_bytes}: '
                           'its step or its encoding is wrong')
    if length != height * step:
        raise MessageError(f'{what} has {length} bytes of data, but height x step is '
                           f'{height * step}: its height, step or data is wrong')
    if layout.even_width and width % 2:
        raise MessageError(f'{what}: two pixels of this encoding share their colour, so its '
                           'width must be even')


def rgb_from_compressed(msg: Any) -> np.ndarray:
    """[H,W,3] uint8 RGB, contiguous, of a sensor_msgs/CompressedImage; raises MessageError.

    Everything that OpenCV decodes, JPEG and PNG among it; 16-bit samples keep their upper 8 bits.
    """
    what = f"a compressed image (format '{msg.format}')"
    if not len(msg.data):
        raise MessageError(f'{what} has no data: check the publisher')
    # An orientation tag would turn the image away from what camera_info describes.
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        bgr = cv2.imdecode(bytes_of(msg.data), flags)
    except cv2.error as error:
        raise MessageError(f'{what} cannot be decoded: {error.err}') from error
    if bgr is None:
        raise MessageError(f'{what} cannot be decoded: it must be a JPEG or PNG file '
                           '(depth images and video packets are not images of a camera)')
    # The publisher names the order it handed to its encoder; OpenCV takes it to be BGR.
    return bgr if 'compressed rgb' in msg.format else cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)


def is_rectified(image_topic: str, msg: Any) -> bool:
    """Whether a CameraInfo's P holds for the images of this topic, and without distortion.

    image_proc names what it has rectified image_rect or image_rect_color; the camera_info beside
    it is that of the raw images.
    """
    named = any(part.startswith('image_rect') for part in image_topic.split('/'))
    return named and bool(np.any(_field(msg, 'p')))


def published_size(msg: Any) -> tuple[int, int]:
    """Width and height of the images that a CameraInfo belongs to, binned and cut; 0 unknown."""
    roi = getattr(msg, 'roi', None)
    width, height = ((getattr(roi, side, 0) or getattr(msg, side))
                     // (getattr(msg, f'binning_{axis}', 1) or 1)
                     for side, axis in (('width', 'x'), ('height', 'y')))
    return int(width), int(height)


def K_from_camera_info(msg: Any, rectified: bool = False) -> np.ndarray | None:
    """[3,3] float64 in pixels of the image as published; None for zeros: not calibrated.

    K of the message is that of the full sensor: binning and a region of interest are applied.
    rectified: that of P instead. Raises MessageError for numbers that are not those of a camera.
    """
    values = np.array(_field(msg, 'k'), np.float64)
    if values.shape != (9,):
        raise MessageError(f'K of camera_info has {values.size} values instead of 9')
    if not values.any():
        return None
    K = values.reshape(3, 3)
    if rectified:
        K = np.array(_field(msg, 'p'), np.float64).reshape(3, 4)[:, :3].copy()
    if not np.isfinite(K).all():
        raise MessageError('K of camera_info holds values that are not finite: calibrate the '
                           'camera, or publish zeros to say that it is not calibrated')
    if K[0, 0] <= 0 or K[1, 1] <= 0:
        raise MessageError(f'the focal lengths of camera_info are {K[0, 0]:g} and {K[1, 1]:g}, '
                           'but must be positive')
    return _in_published_image(K, msg)


def _in_published_image(K: np.ndarray, msg: Any) -> np.ndarray:
    roi = getattr(msg, 'roi', None)
    for axis, name in enumerate('xy'):
        K[axis, 2] -= getattr(roi, f'{name}_offset', 0)
        K[axis] /= getattr(msg, f'binning_{name}', 1) or 1   # 0 means 1
    return K


def has_distortion(msg: Any) -> bool:
    """Whether a CameraInfo has a distortion coefficient other than 0."""
    return bool(np.any(np.asarray(_field(msg, 'd'), np.float64)))


def _field(msg: Any, name: str) -> Any:
    """k, d and p are K, D and P in ROS 1."""
    return getattr(msg, name) if hasattr(msg, name) else getattr(msg, name.upper())
