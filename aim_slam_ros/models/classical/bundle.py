"""A small bundle adjustment: a few cameras around a hub, one inverse depth per hub feature.

Point m lies on the hub's ray x_m (z = 1) at depth 1/rho_m; in camera v it is at R x + rho t up to
scale, so that points at infinity need no special case. Levenberg-Marquardt, Cauchy weights, the
inverse depths eliminated by a Schur complement.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

_CAUCHY_PX = 1.5
MIN_RHO = 1e-3


@dataclass(frozen=True)
class Observations:
    """O observations: in camera view[O], of point[O], at xy [O,2] (normalised, z = 1).

    focal_px: pixels per unit of xy, so that residuals are weighed in pixels.
    """

    view: np.ndarray
    point: np.ndarray
    xy: np.ndarray
    focal_px: float


@dataclass(frozen=True)
class Bundle:
    """T_view_hub: [V,4,4] rigid; rays: [M,3] with z = 1 in the hub; rho: [M] inverse depths."""

    T_view_hub: np.ndarray
    rays: np.ndarray
    rho: np.ndarray


@dataclass(frozen=True)
class Adjusted:
    """The adjusted bundle; residual_px [O] and the robust cost of its observations."""

    bundle: Bundle
    residual_px: np.ndarray
    cost: float


def adjust(bundle: Bundle, seen: Observations, iterations: int) -> Adjusted:
    """Minimise the robust reprojection error. The gauge (scale) is held by the damping."""
    damping = 1e-3
    residual, J_pose, J_rho = _linearise(bundle, seen)
    cost = _cost(residual)
    for _ in range(iterations):
        candidate = _step(bundle, seen, residual, J_pose, J_rho, damping)
        new_residual, new_pose, new_rho = _linearise(candidate, seen)
        new_cost = _cost(new_residual)
        if new_cost > cost:
            damping = min(damping * 8.0, 1e4)
            continue
        converged = cost - new_cost < 1e-4 * cost
        bundle, residual, J_pose, J_rho = candidate, new_residual, new_pose, new_rho
        cost, damping = new_cost, max(damping * 0.25, 1e-7)
        if converged:
            break
    return Adjusted(bundle, np.linalg.norm(residual, axis=1), cost)


def _linearise(bundle: Bundle, seen: Observations) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Residuals [O,2] in pixels and their derivatives by pose [O,2,6] and by rho [O,2]."""
    T = bundle.T_view_hub[seen.view]
    rho = bundle.rho[seen.point]
    P = np.einsum('nij,nj->ni', T[:, :3, :3], bundle.rays[seen.point]) + rho[:, None] * T[:, :3, 3]
    z = np.maximum(P[:, 2], 0.05)
    a, b = P[:, 0] / z, P[:, 1] / z
    residual = seen.focal_px * (np.stack([a, b], 1) - seen.xy)
    zero, w = np.zeros_like(a), rho / z
    J_pose = seen.focal_px * np.stack([
        np.stack([w, zero, -w * a, -a * b, 1 + a * a, -b], 1),
        np.stack([zero, w, -w * b, -(1 + b * b), a * b, a], 1)], 1)
    t = T[:, :3, 3]
    J_rho = np.stack([t[:, 0] - a * t[:, 2], t[:, 1] - b * t[:, 2]], 1)
    J_rho *= seen.focal_px / z[:, None]
    return residual, J_pose, J_rho


def _cost(residual: np.ndarray) -> float:
    return float(np.log1p((residual ** 2).sum(1) / _CAUCHY_PX ** 2).sum())


def _step(bundle: Bundle, seen: Observations, residual: np.ndarray, J_pose: np.ndarray,
          J_rho: np.ndarray, damping: float) -> Bundle:
    """One damped Gauss-Newton step, the inverse depths eliminated."""
    views, points = len(bundle.T_view_hub), len(bundle.rho)
    weight = 1.0 / (1.0 + (residual ** 2).sum(1) / _CAUCHY_PX ** 2)
    WJ = weight[:, None, None] * J_pose
    H = np.zeros((views, 6, views, 6))
    g = np.zeros((views, 6))
    blocks = np.einsum('nij,nik->njk', J_pose, WJ)
    gradients = np.einsum('nij,ni->nj', WJ, residual)
    for v in range(views):
        H[v, :, v] = blocks[seen.view == v].sum(0)
        g[v] = gradients[seen.view == v].sum(0)
    cross = np.zeros((views, points, 6))
    np.add.at(cross, (seen.view, seen.point), np.einsum('nij,ni->nj', WJ, J_rho))
    curvature = np.bincount(seen.point, weight * (J_rho ** 2).sum(1), points)
    g_rho = np.bincount(seen.point, weight * (J_rho * residual).sum(1), points)
    h_rho = curvature * (1.0 + damping) + 1.0   # 1 px^2: a weak prior where there is no parallax
    flat = cross.transpose(0, 2, 1).reshape(views * 6, points)
    H_full = H.reshape(views * 6, views * 6)
    H_full = H_full + damping * np.diag(np.diag(H_full) + 1e-6)
    reduced = H_full - (flat / h_rho) @ flat.T
    step = np.linalg.solve(reduced, -(g.reshape(-1) - flat @ (g_rho / h_rho)))
    step_rho = -(g_rho + flat.T @ step) / h_rho
    poses = np.stack([_retract(T, d) for T, d in zip(bundle.T_view_hub, step.reshape(views, 6))])
    return replace(bundle, T_view_hub=poses, rho=np.maximum(bundle.rho + step_rho, MIN_RHO))


def _retract(T: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Left perturbation (translation, rotation) that stays a rigid transform."""
    out = np.eye(4)
    R = cv2.Rodrigues(step[3:])[0]
    out[:3, :3] = R @ T[:3, :3]
    out[:3, 3] = R @ T[:3, 3] + step[:3]
    return out
