"""Coloured point clouds as RViz shows them: x y z FLOAT32 and rgb, packed into a FLOAT32."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from sensor_msgs.msg import PointCloud2

from aim_slam_ros.types import Cloud

from .errors import MessageError
from .tables import rows_of, table_msg

POINT = np.dtype([('x', '<f4'), ('y', '<f4'), ('z', '<f4'), ('rgb', '<f4')])


def cloud_msg(points: np.ndarray, colours: np.ndarray, stamp_ns: int,
              frame_id: str) -> PointCloud2:
    """points: [N,3] float32, NaN where there is none; colours: [N,3] uint8 RGB. N may be 0."""
    points, colours = np.asarray(points), np.asarray(colours)
    if points.ndim != 2 or points.shape[1] != 3 or points.shape != colours.shape:
        raise MessageError(f'points {points.shape} and colours {colours.shape} of a cloud must '
                           'both be [N,3]')
    rows = np.empty(len(points), POINT)
    set_points(rows, points)
    rows['rgb'] = packed(colours)
    return table_msg(rows, stamp_ns, frame_id)


def cloud_from_msg(msg: Any) -> Cloud:
    """Every point of a cloud with x y z rgb, organised or not; raises MessageError."""
    rows = rows_of(msg, POINT)
    return Cloud(points_of(rows).reshape(-1, 3), unpacked(rows['rgb']).reshape(-1, 3))


def set_points(rows: np.ndarray, points: np.ndarray, scale: float = 1.0) -> None:
    """Columns x y z of rows [...] become ``scale`` times the points [...,3]."""
    for axis, name in enumerate('xyz'):
        np.multiply(points[..., axis], np.float32(scale), out=rows[name])


def points_of(rows: np.ndarray, scale: float = 1.0) -> np.ndarray:
    """Columns x y z of rows [...] divided by ``scale``: [...,3] float32, a copy."""
    points = np.empty((*rows.shape, 3), np.float32)
    for axis, name in enumerate('xyz'):
        np.divide(rows[name], np.float32(scale), out=points[..., axis])
    return points


def packed(colours: np.ndarray) -> np.ndarray:
    """[...,3] uint8 RGB to [...] float32 that has the bits 0x00RRGGBB."""
    if not colours.size:
        return np.empty(colours.shape[:-1], np.float32)
    bgra = cv2.cvtColor(np.ascontiguousarray(colours).reshape(1, -1, 3), cv2.COLOR_RGB2BGRA)
    bgra[..., 3] = 0
    return bgra.view('<f4').reshape(colours.shape[:-1])


def unpacked(rgb: np.ndarray) -> np.ndarray:
    """The inverse of packed: [...] float32 to [...,3] uint8 RGB, contiguous."""
    if not rgb.size:
        return np.empty((*rgb.shape, 3), np.uint8)
    bgra = np.ascontiguousarray(rgb).view(np.uint8).reshape(1, -1, 4)
    return cv2.cvtColor(bgra, cv2.COLOR_BGRA2RGB).reshape(*rgb.shape, 3)
