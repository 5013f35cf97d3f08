"""The bytes of a message: ``data`` of an Image, a PointCloud2 or a CompressedImage."""

from __future__ import annotations

import array
from typing import Any

import numpy as np


def data_of(values: np.ndarray) -> array.array[int]:
    """The bytes of an array, as rclpy takes them fastest.

    A message made with ``check_fields=True`` keeps this array as it is (0.06 ms for 0.9 MB, the
    copy made here); a list costs 50 ms and an ndarray 170 ms.
    """
    data = array.array('B')
    data.frombytes(np.ascontiguousarray(values).reshape(-1).view(np.uint8).data)
    return data


def bytes_of(data: Any) -> np.ndarray:
    """[n] uint8, sharing memory with ``data``: array.array, bytes or an array of uint8."""
    return np.frombuffer(data, np.uint8)
