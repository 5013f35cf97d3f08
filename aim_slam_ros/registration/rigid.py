"""A camera's rigid pose from points and the pixels where they were found."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from ..geometry import sim3

_FAR_PX = 1e3   # residual charged for a point behind the camera


@dataclass(frozen=True)
class RigidSolution:
    """T_cam_ref: [4,4] float64, rigid.

    inliers: [N] bool. kappa: reduced chi-square of the inliers, whitened by the given sigmas,
    without the robust weights. information: [6,6] float64 in the tangent (translation, rotation),
    left perturbation of T_cam_ref.
    """

    T_cam_ref: Tensor
    inliers: np.ndarray
    kappa: float
    information: np.ndarray


@dataclass(frozen=True)
class _Linearised:
    squared: np.ndarray       # [N] squared Mahalanobis distance
    H: np.ndarray
    g: np.ndarray
    cost: float


def solve_rigid(points_ref: np.ndarray, uv: np.ndarray, K: Tensor, T_cam_ref_guess: Tensor,
                spread_ref: np.ndarray | None = None, sigma_px: float = 1.0,
                iterations: int = 12) -> RigidSolution:
    """Minimise the robust reprojection error over the 6 degrees of freedom of the camera.

    points_ref: [N,3] in the reference frame; uv: [N,2] px, where the images have them.
    spread_ref: [N,3], one standard deviation of each point as a vector (its depth error along the
    ray it was seen on); a point is then trusted across that direction but not along it.
    Levenberg-Marquardt with Cauchy weights. Points behind the camera cost a constant, so that the
    solver cannot win by turning away from them.
    """
    X = np.asarray(points_ref, np.float64)
    uv = np.asarray(uv, np.float64)
    intrinsics = K.numpy()
    spread = None if spread_ref is None else np.asarray(spread_ref, np.float64)
    T = sim3.rigid_part(T_cam_ref_guess).numpy()
    damping = 1e-4
    now = _linearise(T, X, uv, intrinsics, spread, sigma_px)
    for _ in range(iterations):
        step = np.linalg.solve(now.H + damping * np.diag(np.diag(now.H) + 1e-9), -now.g)
        T_new = _exp_se3(step) @ T
        new = _linearise(T_new, X, uv, intrinsics, spread, sigma_px)
        if new.cost > now.cost:
            damping = min(damping * 10.0, 1e6)
            continue
        gain = now.cost - new.cost
        T, now, damping = T_new, new, max(damping * 0.3, 1e-9)
        if gain < 1e-5 * now.cost:
            break
    return _solution(T, now)


def solve_rigid_from_scratch(points_ref: np.ndarray, uv: np.ndarray, K: Tensor,
                             threshold_px: float = 6.0) -> Tensor | None:
    """T_cam_ref [4,4] by RANSAC over minimal samples, without a guess; None where none is found.

    The result is a start for solve_rigid. Repeatable: OpenCV seeds its sampling itself.
    """
    if len(points_ref) < 6:
        return None
    found, rotation, translation, inliers = cv2.solvePnPRansac(
        np.ascontiguousarray(points_ref, np.float64), np.ascontiguousarray(uv, np.float64),
        K.numpy(), None, iterationsCount=200, reprojectionError=threshold_px,
        flags=cv2.SOLVEPNP_SQPNP)
    if not found or inliers is None or len(inliers) < 6:
        return None
    R = torch.from_numpy(cv2.Rodrigues(rotation)[0])
    return sim3.from_parts(1.0, R, torch.from_numpy(translation[:, 0]))


def _linearise(T: np.ndarray, X: np.ndarray, uv: np.ndarray, K: np.ndarray,
               spread: np.ndarray | None, sigma_px: float) -> _Linearised:
    """Residuals, weights and normal equations at T; Jacobians as in geometry/rays.py."""
    P = X @ T[:3, :3].T + T[:3, 3]
    front = P[:, 2] > 1e-6
    z = np.where(front, P[:, 2], 1.0)
    a, b = P[:, 0] / z, P[:, 1] / z
    fx, fy = K[0, 0], K[1, 1]
    residual = np.stack([fx * a + K[0, 2], fy * b + K[1, 2]], 1) - uv
    residual[~front] = _FAR_PX
    u, v = residual.T
    # A row per parameter, the residual below them; a block per term: u, v, and what the depth
    # errors take back.
    rows = np.zeros((7, 3, len(X)))
    rows[0, 0], rows[2, 0], rows[3, 0] = fx / z, -fx * a / z, -fx * a * b
    rows[4, 0], rows[5, 0], rows[6, 0] = fx * (1 + a * a), -fx * b, u
    rows[1, 1], rows[2, 1], rows[3, 1] = fy / z, -fy * b / z, -fy * (1 + b * b)
    rows[4, 1], rows[5, 1], rows[6, 1] = fy * a * b, fy * a, v
    squared = (u * u + v * v) / sigma_px ** 2
    weight = np.ones((3, len(X)))
    if spread is None:
        weight[2] = 0.0
    else:
        # Along e, the image of the depth error, the variance is sigma^2 + |e|^2: the information
        # is (I - e e^T / (sigma^2 + |e|^2)) / sigma^2.
        turned = spread @ T[:3, :3].T
        e_u = rows[0, 0] * turned[:, 0] + rows[2, 0] * turned[:, 2]
        e_v = rows[1, 1] * turned[:, 1] + rows[2, 1] * turned[:, 2]
        weight[2] = -1.0 / (sigma_px ** 2 + e_u * e_u + e_v * e_v)
        rows[:, 2] = e_u * rows[:, 0] + e_v * rows[:, 1]
        squared += weight[2] * rows[6, 2] ** 2 / sigma_px ** 2
    weight *= np.where(front, 1.0 / (1.0 + squared / _CAUCHY), 0.0) / sigma_px ** 2
    flat = rows.reshape(7, -1)
    equations = (flat[:6] * weight.reshape(-1)) @ flat.T
    cost = _CAUCHY * float(np.log1p(squared / _CAUCHY).sum())
    return _Linearised(squared, equations[:, :6], equations[:, 6], cost)


_CAUCHY = 2.0 ** 2      # squared distance, in sigmas, at which a residual counts half
_INLIER = 3.0 ** 2      # squared distance within which a match counts as explained


def _solution(T: np.ndarray, final: _Linearised) -> RigidSolution:
    inliers = final.squared < _INLIER
    count = int(inliers.sum())
    freedom = 2 * count - 6
    kappa = float(final.squared[inliers].sum()) / freedom if freedom > 0 else float('inf')
    return RigidSolution(torch.from_numpy(T), inliers, kappa, final.H)


def _exp_se3(xi: np.ndarray) -> np.ndarray:
    """exp of (translation, rotation) as [4,4]; the rotation exactly, to stay on the group."""
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(xi[3:])[0]
    T[:3, 3] = xi[:3]
    return T
