"""Robust fits of a rotation alone, and the parallax that it leaves unexplained."""

from __future__ import annotations

import torch
from torch import Tensor


def unit_rays(uv: Tensor, K: Tensor) -> Tensor:
    """Pixels [M,2] to unit rays [M,3] float64 in the camera frame."""
    uv = uv.double()
    xy = (uv - K[:2, 2]) / torch.stack([K[0, 0], K[1, 1]])
    rays = torch.cat([xy, torch.ones_like(xy[:, :1])], 1)
    return rays / rays.norm(dim=1, keepdim=True)


def fit_rotation(rays_a: Tensor, rays_b: Tensor) -> Tensor:
    """R_b_a [3,3] float64 that best turns the unit rays [M,3] of a into those of b, robustly."""
    weights = torch.ones(len(rays_a), dtype=torch.float64)
    R = torch.eye(3, dtype=torch.float64)
    for _ in range(6):
        U, _, Vt = torch.linalg.svd((weights[:, None] * rays_b).T @ rays_a)
        signs = torch.ones(3, dtype=torch.float64)
        signs[2] = torch.linalg.det(U @ Vt)
        R = U @ torch.diag(signs) @ Vt
        residual = (rays_b - rays_a @ R.T).norm(dim=1)
        weights = 1.0 / (residual ** 2 + (residual.median() + 1e-6) ** 2)
    return R


def parallax_px(rays_a: Tensor, rays_b: Tensor, R_b_a: Tensor, focal_px: float) -> float:
    """Median residual of the rotation, in pixels."""
    return float((rays_b - rays_a @ R_b_a.T).norm(dim=1).median()) * focal_px
