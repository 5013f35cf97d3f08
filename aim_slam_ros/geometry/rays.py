"""Rays: matching by them, and the residuals of the joint optimisation with their Jacobians.

With X' = T X, d = |X'| and r = X'/d, all Jacobians are with respect to a left perturbation of T in
the order (translation, rotation, log-scale), so dX' = [I, -[X']x, X']. Residuals are
measured minus predicted.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from . import camera, sim3


@dataclass(frozen=True)
class RayMatches:
    """uv_i: [N,2] sub-pixel position in view i of each point; valid: [N] bool.

    points_i: [N,3], the pointmap of view i there.
    """

    uv_i: Tensor
    points_i: Tensor
    valid: Tensor


@dataclass(frozen=True)
class NormalEquations:
    """H [...,7,7] and g [...,7], float64: the step solves H delta = g."""

    H: Tensor
    g: Tensor

    def __add__(self, other: NormalEquations) -> NormalEquations:
        return NormalEquations(self.H + other.H, self.g + other.g)


def sample(image: Tensor, uv: Tensor) -> Tensor:
    """Bilinear samples [N,C] of image [H,W,C], H, W > 1, at uv [N,2]; nan outside the image."""
    height, width = image.shape[:2]
    ok = camera.inside(uv, height, width)
    uv = torch.where(ok[:, None], uv, torch.zeros_like(uv))
    u0, v0 = uv[:, 0].floor().clamp_max(width - 2), uv[:, 1].floor().clamp_max(height - 2)
    a, b = (uv[:, 0] - u0)[:, None], (uv[:, 1] - v0)[:, None]
    flat, at = image.reshape(height * width, -1), v0.long() * width + u0.long()
    corners = torch.stack([at, at + 1, at + width, at + width + 1])
    found = flat.index_select(0, corners.flatten()).unflatten(
        0, corners.shape)
    values = torch.lerp(torch.lerp(found[0], found[1], a), torch.lerp(found[2], found[3], a), b)
    return values.masked_fill_(~ok[:, None], float('nan'))


def match_rays(points_i: Tensor, points_j_in_i: Tensor, K: Tensor, iterations: int = 4,
               tolerance_px: float = 0.5) -> RayMatches:
    """Where in view i the ray of each point lies, by a fixed point.

    points_i: [H,W,3] pointmap of view i, in its camera frame. points_j_in_i: [N,3]. K: [3,3].
    With U(p) the projection of the pointmap at p and u* that of the point, p <- p + (u* - U(p)):
    U is close to the identity, so the map contracts; where the pointmap was made with this very K,
    U is the identity at pixel centres and no iteration is needed. A match is valid when U(p) ends
    up within ``tolerance_px`` of u*.
    """
    target = uv = camera.project(points_j_in_i, K)
    found = sample(points_i, uv)
    offset = target - camera.project(found, K)
    for _ in range(iterations):
        uv = uv + offset
        found = sample(points_i, uv)
        offset = target - camera.project(found, K)
    return RayMatches(uv, found, offset.square().sum(-1) < tolerance_px ** 2)


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


def ray_normal_equations(points: Tensor, e_ray: Tensor, e_log: Tensor, ray_weight: Tensor,
                         distance_weight: Tensor) -> NormalEquations:
    """Ray and log-distance rows in closed form, without [N,4,7] Jacobians.

    points: [P,3,N], already transformed. e_ray: [P,3,N], difference of unit rays. e_log: [P,N].
    Weights: [P,N], inverse variances. All sums are moments of weights times monomials of the ray:
    one batched matrix product.
    """
    inv_d = points.square().sum(1).rsqrt()
    r = points * inv_d[:, None]
    w, v = ray_weight, distance_weight
    w1, v1 = w * inv_d, v * inv_d
    w2 = w1 * inv_d
    # r x e for w, (I - r r^T) e for w/d; r.e does not cancel, unlike r.m - 1.
    along = v1 * e_log - w1 * (r * e_ray).sum(1)
    left = torch.stack([w, w1, w2, v, v1, v1 * inv_d - w2, along, v * e_log], 1)
    x, y, z = r.unbind(1)
    right = torch.cat([torch.ones_like(w)[:, None], r, r[:, :1] * r, r[:, 1:2] * r[:, 1:],
                       (z * z)[:, None], e_ray, torch.linalg.cross(r, e_ray, dim=1)], 1)
    M = (left @ right.mT).double()   # [P,8,16]: the sums
    outer = M[..., [4, 5, 6, 5, 7, 8, 6, 8, 9]].unflatten(-1, (3, 3))   # sums times r r^T
    eye = torch.eye(3, dtype=M.dtype, device=M.device)
    H = M.new_zeros(len(M), 7, 7)
    H[:, :3, :3] = M[:, 2, 0, None, None] * eye + outer[:, 5]
    H[:, 3:6, 3:6] = M[:, 0, 0, None, None] * eye - outer[:, 0]
    H[:, :3, 3:6] = -sim3.hat(M[:, 1, 1:4])
    H[:, 3:6, :3] = H[:, :3, 3:6].mT
    H[:, :3, 6] = H[:, 6, :3] = M[:, 4, 1:4]
    H[:, 6, 6] = M[:, 3, 0]
    g = torch.cat([M[:, 1, 10:13] + M[:, 6, 1:4], M[:, 0, 13:16], M[:, 7, :1]], -1)
    return NormalEquations(H, g)


def pixel_normal_equations(points: Tensor, e_px: Tensor, weight: Tensor,
                           focal: Tensor) -> NormalEquations:
    """The pixel rows' normal equations.

    points: [P,3,N], already transformed, z > 0. e_px: [P,2,N]. weight: [P,N]. focal: [P,2].
    """
    inv_z = 1.0 / points[:, 2]
    a, b = points[:, 0] * inv_z, points[:, 1] * inv_z
    ab = a * b
    J = points.new_zeros(len(points), 6, 2, points.shape[-1])   # without focal and scale column
    J[:, 0, 0], J[:, 2, 0], J[:, 3, 0], J[:, 4, 0], J[:, 5, 0] = (
        inv_z, -a * inv_z, -ab, 1 + a * a, -b)
    J[:, 1, 1], J[:, 2, 1], J[:, 3, 1], J[:, 4, 1], J[:, 5, 1] = (
        inv_z, -b * inv_z, -1 - b * b, ab, a)
    weighted = (J * (weight[:, None] * focal[..., None].square())[:, None]).flatten(2)
    H, g = points.new_zeros(len(points), 7, 7), points.new_zeros(len(points), 7)
    H[:, :6, :6] = weighted @ J.flatten(2).mT
    g[:, :6] = (weighted @ (e_px / focal[..., None]).flatten(1)[..., None])[..., 0]
    return NormalEquations(H.double(), g.double())
