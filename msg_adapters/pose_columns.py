"""Poses in the columns of a table: x y z qx qy qz qw, and a scale where there is one."""

from __future__ import annotations

from typing import Any

import numpy as np
from torch import Tensor

from .poses import PoseParts, T_ZUP_OPTICAL, join, split

TRANSLATION = ('x', 'y', 'z')
QUATERNION = ('qx', 'qy', 'qz', 'qw')
RIGID = (*TRANSLATION, *QUATERNION)


def set_poses(rows: np.ndarray, Ts: Any, prefix: str = '') -> None:
    """Write transforms [N,4,4] into rows [N]; the scale too where the rows have that column."""
    parts = split(Ts)
    for names, values in ((TRANSLATION, parts.translation), (QUATERNION, parts.quaternion)):
        for column, name in enumerate(names):
            rows[prefix + name] = values[:, column]
    if f'{prefix}scale' in (rows.dtype.names or ()):
        rows[f'{prefix}scale'] = parts.scale


def poses_of(rows: np.ndarray, what: str, prefix: str = '') -> Tensor:
    """The transforms of rows [N]: [N,4,4] float64; MessageError begins with ``what``."""
    translation, quaternion = (
        np.stack([rows[prefix + name].astype(np.float64) for name in names], -1)
        for names in (TRANSLATION, QUATERNION))
    scaled = f'{prefix}scale' in (rows.dtype.names or ())
    scale = rows[f'{prefix}scale'].astype(np.float64) if scaled else np.ones(len(rows))
    return join(PoseParts(translation, quaternion, scale), what)


def z_up(Ts: Tensor) -> Tensor:
    """Poses [...,4,4] in the axes of the first camera to those of map and odom."""
    return T_ZUP_OPTICAL @ Ts


def z_forward(Ts: Tensor) -> Tensor:
    """The inverse of z_up."""
    return T_ZUP_OPTICAL.mT @ Ts
