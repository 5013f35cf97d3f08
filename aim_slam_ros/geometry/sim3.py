"""Sim(3) as batched 4x4 float64 matrices ``[[s R, t], [0, 1]]``.

Tangent order is (translation, rotation, log-scale); perturbations act on the left:
``T <- exp(xi) @ T``. Rigid transforms are the members with s = 1.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

_SMALL = 1e-6


def identity() -> Tensor:
    """[4,4] float64."""
    return torch.eye(4, dtype=torch.float64)


def from_parts(scale: Tensor | float, rotation: Tensor, translation: Tensor) -> Tensor:
    """Scale [...], rotation [...,3,3] and translation [...,3] to [...,4,4] float64."""
    rotation = rotation.to(torch.float64)
    s = torch.as_tensor(scale, dtype=torch.float64)
    T = torch.zeros(*rotation.shape[:-2], 4, 4, dtype=torch.float64)
    T[..., :3, :3] = s[..., None, None] * rotation
    T[..., :3, 3] = translation.to(torch.float64)
    T[..., 3, 3] = 1.0
    return T


def scale_of(T: Tensor) -> Tensor:
    """[...,4,4] to [...]: the scale; the rows of s R have length s."""
    return (T[..., :3, :3].square().sum((-2, -1)) / 3.0).sqrt()


def rotation_of(T: Tensor) -> Tensor:
    """[...,4,4] to [...,3,3]: R, without the scale."""
    return T[..., :3, :3] / scale_of(T)[..., None, None]


def translation_of(T: Tensor) -> Tensor:
    """[...,4,4] to [...,3]."""
    return T[..., :3, 3]


def rigid_part(T: Tensor) -> Tensor:
    """The same rotation and translation with scale 1."""
    return from_parts(torch.ones(T.shape[:-2]), rotation_of(T), translation_of(T))


def with_scale(T: Tensor, scale: Tensor | float) -> Tensor:
    """The same rotation and translation with another scale."""
    return from_parts(scale, rotation_of(T), translation_of(T))


def on_group(T: Tensor) -> Tensor:
    """The member that a matrix [...,4,4] was before rounding moved it away a little.

    ``inverse`` takes its argument for a member: in a chain of poses, each made of the inverse of
    the one before, what rounding adds grows exponentially.
    """
    R = rotation_from_quaternion(quaternion_of(rotation_of(T)))
    return from_parts(scale_of(T), R, translation_of(T))


def inverse(T: Tensor) -> Tensor:
    """[...,4,4] to [...,4,4]."""
    A = T[..., :3, :3]
    A_inv = A.mT / (A.square().sum((-2, -1), keepdim=True) / 3.0)   # (s R)^-1 = (s R)^T / s^2
    out = torch.zeros_like(T)
    out[..., :3, :3] = A_inv
    out[..., :3, 3] = -(A_inv @ T[..., :3, 3:])[..., 0]
    out[..., 3, 3] = 1.0
    return out


def transform(T: Tensor, points: Tensor) -> Tensor:
    """Apply T [4,4] to points [...,3]; the result keeps the points' dtype and device."""
    T = T.to(points)
    return points @ T[:3, :3].T + T[:3, 3]


def hat(v: Tensor) -> Tensor:
    """[...,3] to the skew matrix [...,3,3] with hat(v) w = v x w."""
    zero = torch.zeros_like(v[..., 0])
    x, y, z = v.unbind(-1)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*v.shape[:-1], 3, 3)


def exp(xi: Tensor) -> Tensor:
    """Tangent [...,7] to Sim(3) [...,4,4], by the matrix exponential of its generator."""
    generator = torch.zeros(*xi.shape[:-1], 4, 4, dtype=xi.dtype)
    eye = torch.eye(3, dtype=xi.dtype)
    generator[..., :3, :3] = hat(xi[..., 3:6]) + xi[..., 6, None, None] * eye
    generator[..., :3, 3] = xi[..., :3]
    return torch.linalg.matrix_exp(generator)


def so3_log(R: Tensor) -> Tensor:
    """Rotation [...,3,3] to its axis-angle vector [...,3], through the quaternion."""
    q = quaternion_of(R)
    sin_half = q[..., :3].norm(dim=-1, keepdim=True)
    angle = 2.0 * torch.atan2(sin_half, q[..., 3:])
    factor = torch.where(sin_half < _SMALL, torch.full_like(angle, 2.0),
                         angle / sin_half.clamp_min(1e-300))
    return factor * q[..., :3]


def log(T: Tensor) -> Tensor:
    """Sim(3) [...,4,4] to its tangent [...,7].

    The translation solves t = W tau with W = integral over u in [0, 1] of
    exp(u (hat(omega) + sigma I)) du, read off one augmented matrix exponential.
    """
    sigma = torch.log(scale_of(T))
    omega = so3_log(rotation_of(T))
    A = hat(omega) + sigma[..., None, None] * torch.eye(3, dtype=T.dtype)
    block = torch.zeros(*T.shape[:-2], 6, 6, dtype=T.dtype)
    block[..., :3, :3] = A
    block[..., :3, 3:] = torch.eye(3, dtype=T.dtype)
    W = torch.linalg.matrix_exp(block)[..., :3, 3:]
    tau = torch.linalg.solve(W, T[..., :3, 3:])[..., 0]
    return torch.cat([tau, omega, sigma[..., None]], -1)


def adjoint(T: Tensor) -> Tensor:
    """[...,4,4] to [...,7,7] with T exp(xi) T^-1 = exp(Ad xi)."""
    R, t = rotation_of(T), translation_of(T)
    Ad = torch.zeros(*T.shape[:-2], 7, 7, dtype=T.dtype)
    Ad[..., :3, :3] = T[..., :3, :3]
    Ad[..., :3, 3:6] = hat(t) @ R
    Ad[..., :3, 6] = -t
    Ad[..., 3:6, 3:6] = R
    Ad[..., 6, 6] = 1.0
    return Ad


def quaternion_of(R: Tensor) -> Tensor:
    """Rotation [...,3,3] to a unit quaternion [...,4], xyzw with w >= 0."""
    m = R.reshape(*R.shape[:-2], 9).unbind(-1)
    # Four equivalent forms (Shepperd); the one with the largest pivot is well conditioned.
    pivots = torch.stack([m[0] - m[4] - m[8], m[4] - m[0] - m[8],
                          m[8] - m[0] - m[4], m[0] + m[4] + m[8]], -1) + 1.0
    forms = torch.stack([
        torch.stack([pivots[..., 0], m[1] + m[3], m[2] + m[6], m[7] - m[5]], -1),
        torch.stack([m[1] + m[3], pivots[..., 1], m[5] + m[7], m[2] - m[6]], -1),
        torch.stack([m[2] + m[6], m[5] + m[7], pivots[..., 2], m[3] - m[1]], -1),
        torch.stack([m[7] - m[5], m[2] - m[6], m[3] - m[1], pivots[..., 3]], -1)], -2)
    best = pivots.argmax(-1)[..., None, None].expand(*pivots.shape[:-1], 1, 4)
    q = forms.gather(-2, best)[..., 0, :]
    q = q / q.norm(dim=-1, keepdim=True)
    return torch.where(q[..., 3:] < 0, -q, q)


def rotation_from_quaternion(q: Tensor) -> Tensor:
    """Quaternion [...,4] xyzw, any length but 0, to [...,3,3]."""
    x, y, z, w = (q / q.norm(dim=-1, keepdim=True)).unbind(-1)
    return torch.stack([
        1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
        2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
        2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y),
    ], -1).reshape(*q.shape[:-1], 3, 3)


def mean(T: Tensor, weights: Tensor, iterations: int = 10) -> Tensor:
    """Weighted intrinsic mean of T [N,4,4] with weights [N] >= 0, not all zero."""
    weights = (weights / weights.sum()).to(T.dtype)
    centre = T[int(weights.argmax())]
    for _ in range(iterations):
        step = (weights[:, None] * log(T @ inverse(centre))).sum(0)
        centre = exp(step) @ centre
        if float(step.norm()) < 1e-10:
            break
    return centre


def angle_rad(T_a: Tensor, T_b: Tensor) -> float:
    """Rotation angle between two poses."""
    R = rotation_of(T_a).T @ rotation_of(T_b)
    return math.acos(max(-1.0, min(1.0, (float(R.trace()) - 1.0) / 2.0)))
