"""What the nine numbers of a pose encoding mean."""

from __future__ import annotations

import torch
from torch import Tensor


def extrinsics(encoding: Tensor) -> Tensor:
    """Pose encodings [N,9] to T_cam_world, rigid [N,4,4], in their dtype.

    A translation, a quaternion (x y z w, of any length) and two fields of view.
    """
    x, y, z, w = encoding[:, 3:7].unbind(-1)
    two = 2.0 / encoding[:, 3:7].square().sum(-1)
    rotation = torch.stack([
        1 - two * (y * y + z * z), two * (x * y - z * w), two * (x * z + y * w),
        two * (x * y + z * w), 1 - two * (x * x + z * z), two * (y * z - x * w),
        two * (x * z - y * w), two * (y * z + x * w), 1 - two * (x * x + y * y)], -1)
    T = torch.eye(4, dtype=encoding.dtype, device=encoding.device).repeat(len(encoding), 1, 1)
    T[:, :3, :3] = rotation.unflatten(-1, (3, 3))
    T[:, :3, 3] = encoding[:, :3]
    return T


def intrinsics(encoding: Tensor, height: int, width: int) -> Tensor:
    """Pose encodings [N,9] to K [N,3,3] in pixels of the image; its centre is (W/2, H/2).

    The fields of view are vertical first; one of 0 gives an infinite focal length.
    """
    half_fov_v, half_fov_h = (encoding[:, 7:] / 2.0).unbind(-1)
    K = encoding.new_zeros(len(encoding), 3, 3)
    K[:, 0, 0] = width / 2.0 / half_fov_h.tan()
    K[:, 1, 1] = height / 2.0 / half_fov_v.tan()
    K[:, 0, 2], K[:, 1, 2], K[:, 2, 2] = width / 2.0, height / 2.0, 1.0
    return K
