"""Sim(3) as batched 4x4 float64 matrices ``[[s R, t], [0, 1]]``.

Tangent order is (translation, rotation, log-scale); perturbations act on the left:
``T <- exp(xi) @ T``. Rigid transforms are the members with s = 1.
"""

from __future__ import annotations

import math
from typing import Callable

import numpy as np
import torch
from torch import Tensor

_SMALL = 1e-6


def identity() -> Tensor:
    """[4,4] float64."""
    return torch.eye(4, dtype=torch.float64)


def from_parts(scale: Tensor | float, rotation: Tensor, translation: Tensor) -> Tensor:
    """Scale [...], rotation [...,3,3] and translation [...,3] to [...,4,4] float64."""
    R, s = rotation.numpy(), np.asarray(scale, np.float64)
    T = np.zeros((*R.shape[:-2], 4, 4))
    T[..., :3, :3] = s[..., None, None] * R
    T[..., :3, 3] = translation.numpy()
    T[..., 3, 3] = 1.0
    return torch.from_numpy(T)


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

    Scale, rotation and adjoint take their argument for a member; in a chain of products, what
    rounding adds stays.
    """
    R = rotation_from_quaternion(quaternion_of(rotation_of(T)))
    return from_parts(scale_of(T), R, translation_of(T))


def inverse(T: Tensor) -> Tensor:
    """[...,4,4] to [...,4,4]."""
    return torch.from_numpy(np.linalg.inv(T.numpy()))


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
    """Tangent [...,7] to Sim(3) [...,4,4]: the matrix exponential of its generator."""
    tau, omega, sigma = np.split(xi.numpy(), [3, 6], -1)
    T = np.zeros((*xi.shape[:-1], 4, 4))
    T[..., :3, :3] = _of_generator(np.exp, omega, sigma)
    T[..., :3, 3] = (_of_generator(_mean_exp, omega, sigma) @ tau[..., None])[..., 0]
    T[..., 3, 3] = 1.0
    return torch.from_numpy(T)


def log(T: Tensor) -> Tensor:
    """Sim(3) [...,4,4] to its tangent [...,7], of the smallest rotation angle."""
    M, scale = T.numpy(), scale_of(T).numpy()[..., None]
    omega = _rotation_log(M[..., :3, :3] / scale[..., None])
    sigma = np.log(scale)
    inverse_mean = _of_generator(lambda z: 1.0 / _mean_exp(z), omega, sigma)
    tau = (inverse_mean @ M[..., :3, 3:])[..., 0]
    return torch.from_numpy(np.concatenate([tau, omega, sigma], -1))


def _of_generator(f: Callable[[np.ndarray], np.ndarray], omega: np.ndarray,
                  sigma: np.ndarray) -> np.ndarray:
    """An analytic function f of the matrix hat(omega) + sigma I: [...,3,3].

    omega [...,3], sigma [...,1]. The matrix has the eigenvalue sigma along the axis and
    sigma +- i angle across it.
    """
    angle = np.linalg.norm(omega, axis=-1, keepdims=True)
    axis = omega / np.maximum(angle, 1e-300)
    across, along = f(sigma + 1j * angle), f(sigma + 0j).real
    x, y, z = np.moveaxis(across.imag * axis, -1, 0)
    M = ((along - across.real) * axis)[..., None] * axis[..., None, :]
    M[..., 0, 0] += across.real[..., 0]
    M[..., 1, 1] += across.real[..., 0]
    M[..., 2, 2] += across.real[..., 0]
    M[..., 0, 1] -= z
    M[..., 0, 2] += y
    M[..., 1, 0] += z
    M[..., 1, 2] -= x
    M[..., 2, 0] -= y
    M[..., 2, 1] += x
    return M


def _mean_exp(z: np.ndarray) -> np.ndarray:
    """The mean of exp(u z) over u in [0, 1]: how a motion of constant twist adds up its steps."""
    return np.divide(np.expm1(z), z, out=np.ones_like(z), where=z != 0)


def _rotation_log(R: np.ndarray) -> np.ndarray:
    """Rotation [...,3,3] to its axis-angle vector [...,3], through the quaternion."""
    q = _quaternion(R)
    sin_half = np.linalg.norm(q[..., :3], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sin_half, q[..., 3:])
    factor = np.where(sin_half < _SMALL, 2.0, angle / np.maximum(sin_half, 1e-300))
    rotated: np.ndarray = factor * q[..., :3]
    return rotated


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
    return torch.from_numpy(_quaternion(R.numpy()))


def _quaternion(R: np.ndarray) -> np.ndarray:
    m = np.moveaxis(R.reshape(*R.shape[:-2], 9), -1, 0)
    # Four equivalent forms (Shepperd); the one with the largest pivot is well conditioned.
    forms = np.zeros((*R.shape[:-2], 4, 4), R.dtype)
    forms[..., 0, 0] = 1.0 + m[0] - m[4] - m[8]
    forms[..., 1, 1] = 1.0 - m[0] + m[4] - m[8]
    forms[..., 2, 2] = 1.0 - m[0] - m[4] + m[8]
    forms[..., 3, 3] = 1.0 + m[0] + m[4] + m[8]
    forms[..., 0, 1] = forms[..., 1, 0] = m[1] + m[3]
    forms[..., 0, 2] = forms[..., 2, 0] = m[2] + m[6]
    forms[..., 1, 2] = forms[..., 2, 1] = m[5] + m[7]
    forms[..., 0, 3] = forms[..., 3, 0] = m[7] - m[5]
    forms[..., 1, 3] = forms[..., 3, 1] = m[2] - m[6]
    forms[..., 2, 3] = forms[..., 3, 2] = m[3] - m[1]
    best = np.diagonal(forms, axis1=-2, axis2=-1).argmax(-1)[..., None, None]
    q = np.take_along_axis(forms, best, -2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., 3:] < 0, -q, q)


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
        if float(step.norm()) < 1e-8:
            break
    return centre


def angle_rad(T_a: Tensor, T_b: Tensor) -> float:
    """Rotation angle between two poses."""
    R = rotation_of(T_a).T @ rotation_of(T_b)
    return math.acos(max(-1.0, min(1.0, (float(R.trace()) - 1.0) / 2.0)))
