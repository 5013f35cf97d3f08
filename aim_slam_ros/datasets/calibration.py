"""camera.txt: ``key = value`` lines, ``#`` starts a comment.

Keys: fx fy cx cy [px] (required), width height [px], distortion (OpenCV k1 k2 p1 p2 [k3 ...],
separated by blanks), depth_scale (units of the depth images per metre).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from aim_slam_ros.datasets.base import Calibration, DatasetError
from aim_slam_ros.datasets.text import lines

TUM_DEPTH_SCALE = 5000.0
_REQUIRED = ('fx', 'fy', 'cx', 'cy')
_POSITIVE = ('fx', 'fy', 'width', 'height', 'depth_scale')
_KEYS = (*_REQUIRED, 'width', 'height', 'distortion', 'depth_scale')
# What OpenCV's model takes.
_DISTORTION_LENGTHS = (4, 5, 8, 12, 14)


@dataclass(frozen=True)
class CameraFile:
    """What camera.txt says. depth_scale: units of the depth images per metre."""

    calibration: Calibration
    depth_scale: float


def read_camera_file(path: Path) -> CameraFile | None:
    """The calibration, or None where the file does not exist; raises DatasetError."""
    if not path.exists():
        return None
    values: dict[str, list[float]] = {}
    for line in lines(path, '='):
        where = f'{path}:{line.number}'
        if len(line.fields) != 2 or line.fields[0] not in _KEYS:
            raise DatasetError(where, f'"{" = ".join(line.fields)}" is not understood',
                               f'write "key = value" with a key of {", ".join(_KEYS)}')
        values[line.fields[0]] = _numbers(where, *line.fields)
    missing = [key for key in _REQUIRED if key not in values]
    if missing:
        raise DatasetError(path, f'lacks {", ".join(missing)}',
                           'add them, or remove the file to go without a calibration')
    return _camera({key: value[0] for key, value in values.items()}, values.get('distortion', []))


def _numbers(where: str, key: str, text: str) -> list[float]:
    """The value's numbers, as many as the key takes and in its range."""
    counts = _DISTORTION_LENGTHS if key == 'distortion' else (1,)
    try:
        numbers = [float(part) for part in text.replace(',', ' ').split()]
    except ValueError:
        numbers = []
    positive = key not in _POSITIVE or all(number > 0 for number in numbers)
    if len(numbers) not in counts or not positive or not all(map(math.isfinite, numbers)):
        expected = ' or '.join(map(str, counts)) + (' positive' if key in _POSITIVE else '')
        raise DatasetError(where, f'"{key} = {text}" is not a usable value',
                           f'expected {expected} finite number(s)')
    return numbers


def _camera(value: dict[str, float], distortion: list[float]) -> CameraFile:
    K = np.array([[value['fx'], 0.0, value['cx']],
                  [0.0, value['fy'], value['cy']],
                  [0.0, 0.0, 1.0]])
    calibration = Calibration(K, np.array(distortion) if any(distortion) else None,
                              int(value.get('width', 0)), int(value.get('height', 0)))
    return CameraFile(calibration, value.get('depth_scale', TUM_DEPTH_SCALE))
