"""A coloured cloud drawn without perspective, near surfaces over far ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from aim_slam_ros.types import Cloud

_LONG_SIDE_PX = 640
_MAX_POINTS = 600_000
_MAX_PAINTED_PX = 8_000_000
_OUTLIERS = (1.0, 99.0)   # percentiles between which the drawn box lies


@dataclass(frozen=True)
class Raster:
    """image: [H,W,4] uint8 RGBA, transparent where nothing was seen, row 0 at the top.

    extent: left, right, bottom, top in the unit of the points.
    """

    image: np.ndarray
    extent: tuple[float, float, float, float]


def draw(cloud: Cloud, keep_inside: np.ndarray, nearest: float) -> Raster | None:
    """Draw points given as right, up and away from the viewer; None if nothing is left.

    cloud: points in those three axes. keep_inside: [M,2], right and up, what must not be cut off
    with the outliers. nearest: what is closer to the viewer than this is cut away, so that a
    ceiling or a wall does not hide the scene.
    """
    cloud = _thinned(_select(cloud, cloud.points[:, 2] >= nearest))
    if not len(cloud.points):
        return None
    low, high = np.percentile(cloud.points[:, :2], _OUTLIERS, axis=0)
    if len(keep_inside):
        low, high = np.minimum(low, keep_inside.min(0)), np.maximum(high, keep_inside.max(0))
    margin = 0.02 * float((high - low).max()) + 1e-6
    low, high = low - margin, high + margin
    inside = ((cloud.points[:, :2] > low) & (cloud.points[:, :2] < high)).all(1)
    return Raster(_paint(_select(cloud, inside), low, high),
                  (float(low[0]), float(high[0]), float(low[1]), float(high[1])))


def _paint(cloud: Cloud, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """[H,W,4] uint8: every point a square, painted from far to near."""
    pixel = float((high - low).max()) / _LONG_SIDE_PX
    width, height = np.maximum(np.ceil((high - low) / pixel).astype(int), 1)
    column, from_bottom = ((cloud.points[:, :2] - low) / pixel).astype(int).T
    row = height - 1 - from_bottom
    far_to_near = np.argsort(-cloud.points[:, 2], kind='stable')
    radius = _radius_px(cloud.points, pixel)
    steps = np.arange(-radius, radius + 1)
    offsets = np.stack(np.meshgrid(steps, steps), -1).reshape(1, -1, 2)
    rows = np.clip(row[far_to_near, None] + offsets[..., 0], 0, height - 1)
    columns = np.clip(column[far_to_near, None] + offsets[..., 1], 0, width - 1)
    image = np.zeros((height, width, 4), np.uint8)
    # where an index repeats numpy keeps the last value: the nearest point
    image[rows.ravel(), columns.ravel(), :3] = np.repeat(
        cloud.colours[far_to_near], offsets.shape[1], axis=0)
    image[rows.ravel(), columns.ravel(), 3] = 255
    return image


def _radius_px(points: np.ndarray, pixel: float) -> int:
    """Half the side of a point's square, large enough that a surface closes."""
    if len(points) < 2:
        return 1
    sample = points[::max(len(points) // 2000, 1)]
    spacing = float(np.median(cKDTree(points).query(sample, k=2)[0][:, 1]))
    affordable = int((np.sqrt(_MAX_PAINTED_PX / len(points)) - 1) / 2)
    return int(np.clip(np.ceil(0.6 * spacing / pixel), 1, max(min(5, affordable), 1)))


def _thinned(cloud: Cloud) -> Cloud:
    """At most _MAX_POINTS, evenly taken: more would not be seen."""
    step = -(-len(cloud.points) // _MAX_POINTS)
    return _select(cloud, slice(None, None, step)) if step > 1 else cloud


def _select(cloud: Cloud, which: np.ndarray | slice) -> Cloud:
    return Cloud(cloud.points[which], cloud.colours[which])
