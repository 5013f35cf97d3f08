"""Which keyframes see which voxel of the map (paper, voxel-indexed keyframe map)."""

from __future__ import annotations

from array import array
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ..config import SigmaConfig
from ..geometry import sim3
from ..types import Keyframe

# Three signed voxel coordinates of 21 bits each make one int64 key.
_BITS = 21
_REACH = 1 << (_BITS - 1)


class VoxelIndexError(ValueError):
    """A keyframe that is indexed twice, or one that was never indexed."""


@dataclass(frozen=True)
class Overlap:
    """keyframe_ids: [N] int64, most shared voxels first (then the newest); counts: [N] int64."""

    keyframe_ids: np.ndarray
    counts: np.ndarray


class VoxelIndex:
    """Voxels of one map piece, each with the ids of the keyframes that observe it; exact."""

    def __init__(self, voxel_size: float) -> None:
        """voxel_size: in world units; raises VoxelIndexError unless positive and finite."""
        if not 0.0 < voxel_size < float('inf'):
            raise VoxelIndexError(
                f'a voxel of {voxel_size} world units is no voxel: the first keyframe needs '
                'finite positive depths')
        self.voxel_size = float(voxel_size)
        self._keyframes_of: dict[int, array[int]] = {}
        self._voxels_of: dict[int, np.ndarray] = {}

    def __len__(self) -> int:
        """How many keyframes are indexed."""
        return len(self._voxels_of)

    def __contains__(self, keyframe_id: int) -> bool:
        return keyframe_id in self._voxels_of

    def insert(self, keyframe_id: int, points_world: Tensor) -> None:
        """Index a keyframe's points [N,3]; ids are small non-negative ints, never reused."""
        if keyframe_id in self._voxels_of:
            raise VoxelIndexError(f'keyframe {keyframe_id} is indexed already: move it instead')
        voxels = self._keys(points_world)
        self._voxels_of[keyframe_id] = voxels
        self._add(keyframe_id, voxels)

    def move(self, keyframe_id: int, points_world: Tensor) -> None:
        """Index the keyframe's points [N,3] anew; only voxels that changed are touched."""
        before, after = self._known(keyframe_id), self._keys(points_world)
        self._drop(keyframe_id, np.setdiff1d(before, after, assume_unique=True))
        self._add(keyframe_id, np.setdiff1d(after, before, assume_unique=True))
        self._voxels_of[keyframe_id] = after

    def overlap_of(self, keyframe_id: int) -> Overlap:
        """The other keyframes that share voxels with an indexed one."""
        observers = array('i')
        for voxel in self._known(keyframe_id).tolist():
            observers.extend(self._keyframes_of[voxel])
        counts = np.bincount(np.frombuffer(observers, np.int32), minlength=keyframe_id + 1)
        counts[keyframe_id] = 0
        ids = np.flatnonzero(counts)
        order = np.lexsort((-ids, -counts[ids]))
        return Overlap(ids[order], counts[ids][order])

    def _keys(self, points_world: Tensor) -> np.ndarray:
        """Sorted unique voxel keys [M] int64; what is not finite or too far has none."""
        cells = np.floor(points_world.detach().cpu().numpy().reshape(-1, 3).astype(np.float64)
                         / self.voxel_size)
        with np.errstate(invalid='ignore'):
            cells = cells[(np.abs(cells) < _REACH).all(-1)].astype(np.int64) + _REACH
        return np.unique((cells[:, 0] << 2 * _BITS) | (cells[:, 1] << _BITS) | cells[:, 2])

    def _add(self, keyframe_id: int, voxels: np.ndarray) -> None:
        for voxel in voxels.tolist():
            self._keyframes_of.setdefault(voxel, array('i')).append(keyframe_id)

    def _drop(self, keyframe_id: int, voxels: np.ndarray) -> None:
        for voxel in voxels.tolist():
            observers = self._keyframes_of[voxel]
            observers.remove(keyframe_id)
            if not observers:
                del self._keyframes_of[voxel]

    def _known(self, keyframe_id: int) -> np.ndarray:
        if keyframe_id not in self._voxels_of:
            raise VoxelIndexError(f'keyframe {keyframe_id} is not indexed: insert it first')
        return self._voxels_of[keyframe_id]


def confident_points(keyframe: Keyframe, config: SigmaConfig) -> Tensor:
    """The keyframe's points [N,3] in the world that are worth indexing: subsampled, confident."""
    points = keyframe.points_cam[::config.stride, ::config.stride].reshape(-1, 3)
    confidence = keyframe.confidence[::config.stride, ::config.stride].reshape(-1)
    usable = (points[:, 2] > 0) & torch.isfinite(points).all(-1) & torch.isfinite(confidence)
    points, confidence = points[usable], confidence[usable]
    if len(points):
        points = points[confidence >= torch.quantile(confidence, config.voxel_quantile)]
    return sim3.transform(keyframe.T_world_kf, points)


def relative_voxel_size(keyframe: Keyframe, config: SigmaConfig) -> float:
    """Voxel size in world units: a fraction of the keyframe's median depth, whatever its unit.

    nan where the keyframe has no depth.
    """
    depth = keyframe.points_cam[::config.stride, ::config.stride, 2]
    depth = depth[torch.isfinite(depth) & (depth > 0)]
    scale = sim3.scale_of(keyframe.T_world_kf)
    return config.voxel_fraction * float(depth.median() * scale) if len(depth) else float('nan')
