"""One world-frame cloud out of all keyframes' pointmaps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Mapping

import cv2
import numpy as np
import torch
from torch import Tensor

from ..config import LoopClosureConfig
from ..geometry import sim3
from ..types import Cloud, KeyframeEvent

_MAX_DEPTH_JUMP = 0.08    # relative depth range in 3x3 pixels above which points hang in the air
_MAX_DEPTH = 8.0          # in median depths; what lies beyond is not geometry any more
_KNOWS_NOTHING = 1.01     # confidence up to which a depth is a prior
_BITS = 21                # of a voxel coordinate; three of them fill an int64


@dataclass(frozen=True)
class _Thinned:
    """A keyframe's usable points, thinned in its own frame, where corrections do not reach.

    points_cam: [M,3] float32; colours: [M,3] float32; weights: [M] float32.
    median_depth: in the keyframe's unit.
    """

    points_cam: Tensor
    colours: Tensor
    weights: Tensor
    median_depth: float


@dataclass(frozen=True)
class _Cells:
    """index: [N] int64, the occupied voxel of each point, 0 to count - 1."""

    index: Tensor
    count: int


class FusedMap:
    """Keeps a thinned cloud per keyframe and fuses them at whatever poses are asked for."""

    def __init__(self, config: LoopClosureConfig) -> None:
        self._config = config
        self._pending: list[KeyframeEvent] = []
        self._thinned: dict[int, _Thinned] = {}

    def add(self, event: KeyframeEvent) -> None:
        """Take a keyframe in, or a better one of it; the work waits until a map is asked for."""
        self._pending.append(event)

    def _thin_pending(self) -> None:
        """A keyframe without a usable point contributes nothing."""
        for event in self._pending:
            usable = _usable(event, self._config.map_percentile)
            if bool(usable.any()):
                self._thinned[event.keyframe_id] = _thin(event, usable, self._config.map_voxel)
        self._pending.clear()

    def fuse(self, poses: Mapping[int, Tensor]) -> Cloud:
        """All keyframes in the world, one point per voxel: its confidence-weighted mean.

        poses: T_world_kf [4,4] by keyframe id. The voxel is ``map_voxel`` of the median depth, in
        world units.
        """
        self._thin_pending()
        placed = [(self._thinned[k], T) for k, T in poses.items() if k in self._thinned]
        if not placed:
            return Cloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8))
        depths = torch.tensor([t.median_depth * float(sim3.scale_of(T)) for t, T in placed])
        points = torch.cat([sim3.transform(T, t.points_cam) for t, T in placed])
        colours = torch.cat([t.colours for t, _ in placed])
        weights = torch.cat([t.weights for t, _ in placed])
        voxel = self._config.map_voxel * float(depths.median())
        cells = _cells(points, voxel)
        return Cloud(_cell_mean(points, weights, cells).numpy(),
                     _cell_mean(colours, weights, cells).round().to(torch.uint8).numpy())


def _usable(event: KeyframeEvent, percentile: float) -> Tensor:
    """[H,W] bool: confident, finite, in front, not far outside, on no depth edge."""
    z = event.points_cam[..., 2]
    finite = event.points_cam.isfinite().all(-1) & (z > 0) & event.confidence.isfinite()
    known = finite & (event.confidence > _KNOWS_NOTHING)
    if not bool(known.any()):
        return known
    threshold = np.percentile(event.confidence[known].numpy(), percentile)
    near = z < _MAX_DEPTH * z[known].median()
    return known & (event.confidence >= float(threshold)) & near & _smooth(z)


def _smooth(z: Tensor) -> Tensor:
    """[H,W] bool: the surface does not break here; a network draws points across the breaks."""
    log_z = torch.log(z.clamp_min(1e-9)).nan_to_num().numpy()
    cross = cv2.getStructuringElement(cv2.MORPH_RECT, (3, 3))
    span = cv2.dilate(log_z, cross) - cv2.erode(log_z, cross)
    return torch.from_numpy(span < _MAX_DEPTH_JUMP)


def _thin(event: KeyframeEvent, usable: Tensor, voxel_fraction: float) -> _Thinned:
    points = event.points_cam[usable].to(torch.float32)
    colours = torch.from_numpy(event.image)[usable].to(torch.float32)
    weights = event.confidence[usable].to(torch.float32)
    median_depth = float(points[:, 2].median())
    cells = _cells(points, voxel_fraction * median_depth)
    total = torch.zeros(cells.count).index_add_(0, cells.index, weights)
    return _Thinned(_cell_mean(points, weights, cells), _cell_mean(colours, weights, cells),
                    total, median_depth)


def _cells(points: Tensor, voxel: float) -> _Cells:
    """Voxels of points [N,3]; coordinates beyond 2^20 voxels from the median share the border.

    The median point, often a voxel's mean itself, is put into a voxel's middle, where rounding
    cannot tip its likes over.
    """
    cell = torch.round((points.double() - points.double().median(0).values) / voxel)
    half = 2 ** (_BITS - 1)
    i, j, k = (cell.clamp(-half, half - 1).long() + half).unbind(-1)
    key = (i << 2 * _BITS) | (j << _BITS) | k
    occupied, index = key.unique(return_inverse=True)
    return _Cells(index, len(occupied))


def _cell_mean(values: Tensor, weights: Tensor, cells: _Cells) -> Tensor:
    """Weighted mean of values [N,3] in each cell, [count,3] float32."""
    total = torch.zeros(cells.count, dtype=torch.float64)
    total.index_add_(0, cells.index, weights.double())
    summed = torch.zeros(cells.count, 3, dtype=torch.float64)
    summed.index_add_(0, cells.index, values.double() * weights.double()[:, None])
    return (summed / total[:, None].clamp_min(1e-12)).to(torch.float32)
