"""Rays: matching by them, and the residuals of the joint optimisation with their Jacobians.

With X' = T X, d = |X'| and r = X'/d, all Jacobians are with respect to a left perturbation of T in
the order (translation, rotation, log-scale), so dX' = [I, -[X']x, X'] (FACTS 4.4). Residuals are
measured minus predicted.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from . import camera, sim3


@dataclass(frozen=True)
class RayMatches:
    """uv_i: [N,2] sub-pixel position in view i of each point; valid: [N] bool."""

    uv_i: Tensor
    valid: Tensor


@dataclass(frozen=True)
class NormalEquations:
    """H [7,7] and g [7], float64: the step solves H delta = g."""

    H: Tensor
    g: Tensor

    def __add__(self, other: NormalEquations) -> NormalEquations:
        return NormalEquations(self.H + other.H, self.g + other.g)


def sample(image: Tensor, uv: Tensor) -> Tensor:
    """Bilinear samples [N,C] of image [H,W,C] at uv [N,2]; nan outside the image."""
    height, width = image.shape[:2]
    ok = camera.inside(uv, height, width)
    uv = torch.where(ok[:, None], uv, torch.zeros_like(uv))
    u0 = uv[:, 0].floor().clamp_max(max(width - 2, 0))
    v0 = uv[:, 1].floor().clamp_max(max(height - 2, 0))
    a, b = (uv[:, 0] - u0)[:, None], (uv[:, 1] - v0)[:, None]
    flat, at = image.reshape(height * width, -1), (v0 * width + u0).long()
    right, down = int(width > 1), width * int(height > 1)
    top = torch.lerp(flat[at], flat[at + right], a)
    bottom = torch.lerp(flat[at + down], flat[at + down + right], a)
    values = torch.lerp(top, bottom, b)
    return torch.where(ok[:, None], values, torch.full_like(values, float('nan')))


def match_rays(points_i: Tensor, points_j_in_i: Tensor, K: Tensor, iterations: int = 4,
               tolerance_px: float = 0.5) -> RayMatches:
    """Where in view i the ray of each point lies, by a fixed point (FACTS 4.3).

    points_i: [H,W,3] pointmap of view i, in its camera frame. points_j_in_i: [N,3]. K: [3,3].
    With U(p) the projection of the pointmap at p and u* that of the point, p <- p + (u* - U(p)):
    U is close to the identity, so the map contracts. A match is valid when U(p) ends up within
    ``tolerance_px`` of u*.
    """
    target = camera.project(points_j_in_i, K)
    uv = target
    offset = target - camera.project(sample(points_i, uv), K)
    for _ in range(iterations):
        # A pointmap made with this very K maps each pixel onto itself: nothing to search.
        if float(offset.nan_to_num(0.0).abs().max() if len(offset) else 0.0) < 1e-3:
            break
        uv = uv + offset
        offset = target - camera.project(sample(points_i, uv), K)
    return RayMatches(uv, offset.norm(dim=-1) < tolerance_px)


def rays_of(points: Tensor) -> Tensor:
    """Points [...,3] to unit rays [...,3]."""
    return points / points.norm(dim=-1, keepdim=True)


def point_jacobian(points: Tensor) -> Tensor:
    """d(exp(xi) X')/d xi at xi = 0: points [N,3] to [N,3,7]."""
    eye = torch.eye(3, dtype=points.dtype, device=points.device).expand(len(points), 3, 3)
    return torch.cat([eye, -sim3.hat(points), points[:, :, None]], -1)


def ray_derivative(points: Tensor) -> Tensor:
    """dr/dX = (I - r r^T)/|X|: points [...,3] to [...,3,3]."""
    d = points.norm(dim=-1)[..., None, None]
    r = points[..., None] / d
    return (torch.eye(3, dtype=points.dtype, device=points.device) - r @ r.mT) / d


def ray_jacobian(points: Tensor) -> Tensor:
    """Jacobian [N,3,7] of the ray of points [N,3]: rank 2, blind to scale."""
    return ray_derivative(points) @ point_jacobian(points)


def log_distance_jacobian(points: Tensor) -> Tensor:
    """Jacobian [N,7] of log |X'| for points [N,3]: (r^T/d, 0, 1)."""
    r_over_d = points / points.square().sum(-1, keepdim=True)
    return torch.cat([r_over_d, torch.zeros_like(points), torch.ones_like(points[:, :1])], -1)


def pixel_jacobian(points: Tensor, K: Tensor) -> Tensor:
    """Jacobian [N,2,7] of the projection of points [N,3] (z > 0) with K [3,3]; blind to scale."""
    K = K.to(points)
    inv_z = 1.0 / points[:, 2]
    a, b, zero = points[:, 0] * inv_z, points[:, 1] * inv_z, torch.zeros_like(inv_z)
    u = torch.stack([inv_z, zero, -a * inv_z, -a * b, 1 + a * a, -b, zero], -1)
    v = torch.stack([zero, inv_z, -b * inv_z, -1 - b * b, a * b, a, zero], -1)
    return torch.stack([K[0, 0] * u, K[1, 1] * v], 1)


def ray_normal_equations(points: Tensor, rays: Tensor, log_ratio: Tensor, ray_weight: Tensor,
                         distance_weight: Tensor) -> NormalEquations:
    """The ray and log-distance rows' normal equations in closed form, without an [N,4,7] Jacobian.

    points: [N,3], already transformed (X'). rays: [N,3] measured. log_ratio: [N], measured minus
    predicted log-distance. Weights: [N], inverse variances. Sums run in float64 (FACTS 4.4).
    """
    d_inv = points.norm(dim=-1).reciprocal()
    r = points * d_inv[:, None]
    w, v = ray_weight, distance_weight
    w1, w2, v1 = w * d_inv, w * d_inv * d_inv, v * d_inv
    v2 = v1 * d_inv
    along = (r * rays).sum(-1)
    r64, rays64 = r.double(), rays.double()

    def isotropic(weight: Tensor) -> Tensor:
        return weight.sum(dtype=torch.float64) * torch.eye(3, dtype=torch.float64,
                                                           device=weight.device)

    H = torch.zeros(7, 7, dtype=torch.float64, device=points.device)
    H[:3, :3] = isotropic(w2) + (r64 * (v2 - w2).double()[:, None]).T @ r64
    H[3:6, 3:6] = isotropic(w) - (r64 * w.double()[:, None]).T @ r64
    H[:3, 3:6] = -sim3.hat(w1.double() @ r64)
    H[3:6, :3] = H[:3, 3:6].T
    H[:3, 6] = H[6, :3] = v1.double() @ r64
    H[6, 6] = v.sum(dtype=torch.float64)
    # (I - r r^T) e = m - r (r.m) and r x e = r x m for the residual e = m - r of unit rays.
    g = torch.cat([w1.double() @ rays64 + (v1 * log_ratio - w1 * along).double() @ r64,
                   w.double() @ torch.linalg.cross(r, rays).double(),
                   (v * log_ratio).sum(dtype=torch.float64)[None]])
    return NormalEquations(H, g)


def pixel_normal_equations(points: Tensor, offset: Tensor, weight: Tensor,
                           K: Tensor) -> NormalEquations:
    """The pixel rows' normal equations.

    points: [N,3], already transformed. offset: [N,2] measured minus predicted pixel. weight: [N].
    """
    J = pixel_jacobian(points, K).reshape(-1, 7)
    weighted = (J * weight.repeat_interleave(2)[:, None]).double()
    return NormalEquations(weighted.T @ J.double(), weighted.T @ offset.reshape(-1).double())
