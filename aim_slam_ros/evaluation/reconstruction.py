"""The map as a file, and how far it is from the true surface."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from aim_slam_ros.types import Cloud

VOXEL_M = 0.01
CUT_M = 0.5
_VERTEX = np.dtype([('x', '<f4'), ('y', '<f4'), ('z', '<f4'),
                    ('red', 'u1'), ('green', 'u1'), ('blue', 'u1')])
_PLY_TYPES = {'f': 'float', 'u': 'uchar'}


@dataclass(frozen=True)
class ReconstructionError:
    """Distances between an estimated and a true cloud.

    accuracy_m: root mean square of the distances from each estimated point to the nearest true
    one; completion_m: from each true point to the nearest estimated one.
    """

    accuracy_m: float
    completion_m: float

    @property
    def chamfer_m(self) -> float:
        return 0.5 * (self.accuracy_m + self.completion_m)


def compare_clouds(estimate: np.ndarray, reference: np.ndarray) -> ReconstructionError | None:
    """Both clouds [N,3] in metres, in one world; None where either holds no point.

    Of each cloud one point per voxel counts, so that what was seen often weighs no more than the
    rest. A distance beyond CUT_M counts as CUT_M: how far off an outlier is says nothing.
    """
    estimate, reference = thinned(estimate, VOXEL_M), thinned(reference, VOXEL_M)
    if not len(estimate) or not len(reference):
        return None
    return ReconstructionError(_rms_to_nearest(estimate, reference),
                               _rms_to_nearest(reference, estimate))


def thinned(points: np.ndarray, voxel: float) -> np.ndarray:
    """One point [M,3] float64 for each occupied voxel, the mean of what lies in it.

    points: [N,3]; those that are not finite are left out, and those beyond 2^20 voxels from the
    origin share the voxels of the border. The origin is the middle of a voxel.
    """
    points = points[np.isfinite(points).all(1)].astype(np.float64)
    cell = np.rint(points / voxel).clip(-2.0 ** 20, 2.0 ** 20 - 1.0).astype(np.int64) + 2 ** 20
    key = (cell[:, 0] << 42) | (cell[:, 1] << 21) | cell[:, 2]
    _, index, count = np.unique(key, return_inverse=True, return_counts=True)
    return np.stack([np.bincount(index, axis) / count for axis in points.T], 1)


def write_ply(path: Path, cloud: Cloud) -> None:
    """Binary little-endian PLY, x y z as float and red green blue as uchar."""
    vertices = np.empty(len(cloud.points), _VERTEX)
    for column, name in enumerate(('x', 'y', 'z')):
        vertices[name] = cloud.points[:, column]
    for column, name in enumerate(('red', 'green', 'blue')):
        vertices[name] = cloud.colours[:, column]
    properties = [f'property {_PLY_TYPES[_VERTEX[name].kind]} {name}'
                  for name in _VERTEX.names or ()]
    header = '\n'.join(['ply', 'format binary_little_endian 1.0',
                        f'element vertex {len(vertices)}', *properties, 'end_header', ''])
    path.write_bytes(header.encode('ascii') + vertices.tobytes())


def _rms_to_nearest(points: np.ndarray, surface: np.ndarray) -> float:
    """Searched only as far as CUT_M, which bounds the time where the clouds lie apart."""
    # built by the sliding midpoint rule: twice as fast, and as fast to search
    tree = cKDTree(surface, compact_nodes=False, balanced_tree=False)
    distance, _ = tree.query(points, distance_upper_bound=CUT_M)
    return float(np.sqrt(np.square(np.minimum(distance, CUT_M)).mean()))
