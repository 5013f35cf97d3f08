"""Reading single image files."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from aim_slam_ros.datasets.base import Calibration, DatasetError, ImageError

SUFFIXES = frozenset({'.bmp', '.jpeg', '.jpg', '.pgm', '.png', '.ppm', '.tif', '.tiff', '.webp'})
# Decoders fill what a torn file lacks with grey and say nothing. A complete file ends in its
# end marker, give or take the padding of some cameras.
_ENDINGS = {b'\xff\xd8': b'\xff\xd9', b'\x89PNG': b'IEND'}
_PADDING_BYTES = 4096


def read_image(path: Path) -> np.ndarray:
    """[H,W,3] uint8 RGB; grey and 16-bit images are converted. Raises ImageError."""
    return cv2.cvtColor(_decoded(path, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


def read_depth(path: Path, units_per_metre: float) -> np.ndarray:
    """[H,W] float32 metres, 0 where unknown. Raises ImageError."""
    raw = _decoded(path, cv2.IMREAD_UNCHANGED)
    if raw.ndim != 2:
        raise ImageError(path, f'a depth image has one channel, this one has {raw.shape[2]}')
    return (raw.astype(np.float64) / units_per_metre).astype(np.float32)


def check_size(path: Path, calibration: Calibration | None) -> None:
    """Raises DatasetError where an image's size is not the calibration's.

    An image that cannot be read says nothing about the size.
    """
    if calibration is None or not calibration.width or not calibration.height:
        return
    try:
        height, width = read_image(path).shape[:2]
    except ImageError:
        return
    if (width, height) != (calibration.width, calibration.height):
        raise DatasetError(
            path, f'is {width}x{height} pixels, its calibration is for '
            f'{calibration.width}x{calibration.height}',
            'correct the calibration or use the images it was made for')


def _decoded(path: Path, mode: int) -> np.ndarray:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ImageError(path, f'cannot be read ({error.strerror})') from error
    if not data:
        raise ImageError(path, 'the file is empty')
    for start, end in _ENDINGS.items():
        if data.startswith(start) and end not in data[-_PADDING_BYTES:]:
            raise ImageError(path, 'the file is cut short')
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), mode)
    except cv2.error:   # a header that tells an absurd size
        image = None
    if image is None:
        raise ImageError(path, 'cannot be decoded: no image, or a damaged one')
    return image
