"""The pinhole camera: OpenCV axes, pixel centres at integers."""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from torch import Tensor


def intrinsics(fx: float, fy: float, cx: float, cy: float) -> Tensor:
    """[3,3] float64."""
    return torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], dtype=torch.float64)


def intrinsics_from_fov(width: int, height: int, fov_deg: float, aspect: float = 1.0) -> Tensor:
    """K of a camera with this horizontal field of view, centred as VGGT's (cx = W/2).

    aspect: fy/fx.
    """
    fx = 0.5 * width / math.tan(math.radians(fov_deg) / 2.0)
    return intrinsics(fx, fx * aspect, width / 2.0, height / 2.0)


def scaled(K: Tensor, scale_x: float, scale_y: float) -> Tensor:
    """K after a resize by these factors (pixel centres at integers: c' = (c + .5) s - .5)."""
    out = K.clone()
    out[..., 0, :2] *= scale_x
    out[..., 1, 1] *= scale_y
    out[..., 0, 2] = (K[..., 0, 2] + 0.5) * scale_x - 0.5
    out[..., 1, 2] = (K[..., 1, 2] + 0.5) * scale_y - 0.5
    return out


@lru_cache(maxsize=8)
def pixel_grid(height: int, width: int, device: str = 'cpu') -> Tensor:
    """[H,W,2] float32: (u, v) of every pixel. Shared: do not write into it."""
    v, u = torch.meshgrid(torch.arange(height, dtype=torch.float32, device=device),
                          torch.arange(width, dtype=torch.float32, device=device), indexing='ij')
    return torch.stack([u, v], -1)


@lru_cache(maxsize=8)
def grid_indices(height: int, width: int, stride: int, device: str = 'cpu') -> Tensor:
    """[M] int64: flat indices of every ``stride``-th pixel, both ways. Shared: do not write."""
    rows = torch.arange(stride // 2, height, stride, device=device)
    columns = torch.arange(stride // 2, width, stride, device=device)
    return (rows[:, None] * width + columns).reshape(-1)


def unproject(depth: Tensor, K: Tensor) -> Tensor:
    """Depth [...,H,W] with K [...,3,3] to points [...,H,W,3] in the camera frame."""
    uv = pixel_grid(depth.shape[-2], depth.shape[-1], str(depth.device))
    K = K.to(depth)
    x = (uv[0, :, 0] - K[..., 0, 2, None]) / K[..., 0, 0, None]
    y = (uv[:, 0, 1] - K[..., 1, 2, None]) / K[..., 1, 1, None]
    # Each coordinate where it belongs at once: six times as fast as joining them.
    points = depth.new_empty(*depth.shape, 3)
    points[..., 0] = depth * x[..., None, :]
    points[..., 1] = depth * y[..., :, None]
    points[..., 2] = depth
    return points


def project(points: Tensor, K: Tensor) -> Tensor:
    """Points [...,3] in the camera frame to pixels [...,2]; z <= 0 gives nan."""
    K = K.to(points)
    z = points[..., 2:]
    z = torch.where(z > 0, z, torch.full_like(z, math.nan))
    focal = torch.stack([K[0, 0], K[1, 1]])
    return points[..., :2] / z * focal + K[:2, 2]


def inside(uv: Tensor, height: int, width: int) -> Tensor:
    """[...] bool: which pixels [...,2] lie in the image; nan does not."""
    u, v = uv.unbind(-1)
    return (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)
