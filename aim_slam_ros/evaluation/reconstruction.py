"""The map as a file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from aim_slam_ros.types import Cloud

_VERTEX = np.dtype([('x', '<f4'), ('y', '<f4'), ('z', '<f4'),
                    ('red', 'u1'), ('green', 'u1'), ('blue', 'u1')])
_PLY_TYPES = {'f': 'float', 'u': 'uchar'}


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
