"""Poses and sparse points of a window of views, from feature matches to one hub view."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Sequence

import cv2
import numpy as np
import torch
from torch import Tensor

from ...config import ClassicalConfig
from ...geometry import rotation, sim3
from .bundle import MIN_RHO, Adjusted, Bundle, Observations, adjust
from .features import ClassicalFeatures
from .matches import Matcher, PairMatches, essential_pose

_OUTLIER_PX = 3.0
_MAX_RELATIVE_SIGMA = 0.12   # sparse points with a worse depth are not used
_LOST_VIEW_PX = 10.0         # charged per match of a view that no pose could be found for


@dataclass(frozen=True)
class SparsePoints:
    """Pixels uv [M,2] of one view and the depth [M] of the points seen there."""

    uv: np.ndarray
    depth: np.ndarray


@dataclass(frozen=True)
class WindowPoses:
    """T_first_view: [N,4,4] float64 rigid, the sparse points' median depth near 1.

    connected: [N] bool; the pose of an unconnected view means nothing. rotation_only: there is no
    parallax, translations are zero. points: for each view.
    """

    T_first_view: Tensor
    connected: np.ndarray
    rotation_only: bool
    points: tuple[SparsePoints, ...]


@dataclass(frozen=True)
class _Pair:
    """Matches of the hub with one other view: rows of hub features, pixels, rays, parallax."""

    view: int
    hub_rows: np.ndarray
    uv_hub: np.ndarray
    uv: np.ndarray
    xy: np.ndarray
    R_view_hub: Tensor
    parallax_px: float


@dataclass(frozen=True)
class _Hypothesis:
    """uv: [O,2] pixels of the observations; hub_rows: [M] hub feature of each point."""

    adjusted: Adjusted
    seen: Observations
    uv: np.ndarray
    views: list[int]
    hub_rows: np.ndarray
    cost: float


def window_poses(features: Sequence[ClassicalFeatures], K: Sequence[Tensor],
                 matcher: Matcher, config: ClassicalConfig, width: int,
                 seed: int) -> WindowPoses:
    """Relative poses of N views; see WindowPoses. seed: of the random sampling."""
    hub = _choose_hub(features, matcher, config)
    pairs = _pairs(hub, features, K, matcher, config)
    gate_px = config.rotation_gate_px * width / 518.0
    moving = [p for p in pairs if p.parallax_px >= gate_px]
    if not moving:
        return _rotations(hub, pairs, len(features))
    moving.sort(key=lambda p: -len(p.uv) * min(p.parallax_px, 4.0 * gate_px))
    found = [h for pair in moving[:2]
             if (h := _hypothesis(pair, pairs, K, hub, seed)) is not None]
    if not found:
        return _rotations(hub, pairs, len(features))
    return _result(min(found, key=lambda h: h.cost), hub, features)


def _choose_hub(features: Sequence[ClassicalFeatures], matcher: Matcher,
                config: ClassicalConfig) -> int:
    """The view with the most matches; weak pairs do not count."""
    n = len(features)
    counts = np.zeros(n)
    for i in range(n):
        for j in range(i + 1, n):
            matched = len(matcher.match(features[i], features[j]))
            counts[[i, j]] += matched if matched >= config.min_matches else 0
    return int(counts.argmax())


def _pairs(hub: int, features: Sequence[ClassicalFeatures], K: Sequence[Tensor],
           matcher: Matcher, config: ClassicalConfig) -> list[_Pair]:
    pairs = []
    for view in range(len(features)):
        if view == hub:
            continue
        matches: PairMatches = matcher.match(features[hub], features[view])
        if len(matches) < config.min_matches:
            continue
        uv_hub = features[hub].uv[matches.rows_a]
        uv = features[view].uv[matches.rows_b]
        rays_hub = rotation.unit_rays(torch.from_numpy(uv_hub), K[hub])
        rays = rotation.unit_rays(torch.from_numpy(uv), K[view])
        R = rotation.fit_rotation(rays_hub, rays)
        parallax = rotation.parallax_px(rays_hub, rays, R, float(K[hub][0, 0]))
        pairs.append(_Pair(view, matches.rows_a, uv_hub, uv, _normalised(uv, K[view]), R,
                           parallax))
    return pairs


def _normalised(uv: np.ndarray, K: Tensor) -> np.ndarray:
    k = K.numpy()
    return (uv.astype(np.float64) - k[:2, 2]) / (k[0, 0], k[1, 1])


def _rays(xy: np.ndarray) -> np.ndarray:
    return np.concatenate([xy, np.ones((len(xy), 1))], 1)


def _rotations(hub: int, pairs: list[_Pair], n: int) -> WindowPoses:
    """No parallax: rotations only."""
    T_view_hub = torch.eye(4, dtype=torch.float64).repeat(n, 1, 1)
    connected = np.zeros(n, bool)
    connected[hub] = bool(pairs)
    for pair in pairs:
        T_view_hub[pair.view, :3, :3] = pair.R_view_hub
        connected[pair.view] = True
    empty = SparsePoints(np.zeros((0, 2)), np.zeros(0))
    return WindowPoses(T_view_hub[0] @ sim3.inverse(T_view_hub), connected, True, (empty,) * n)


def _hypothesis(first: _Pair, pairs: list[_Pair], K: Sequence[Tensor], hub: int,
                seed: int) -> _Hypothesis | None:
    """Start from one pair's essential matrix, add the other views by PnP, adjust all."""
    relative = essential_pose(first.uv_hub, first.uv, K[hub], K[first.view], seed)
    if relative is None:
        return None
    T_first, inliers = relative[0].numpy(), relative[1]
    rays = _rays(_normalised(first.uv_hub, K[hub]))
    rho = _triangulate(T_first, rays, first.xy)
    usable = inliers & (rho > MIN_RHO)
    if usable.sum() < 12:
        return None
    T_first[:3, 3] *= np.median(rho[usable])
    rho = np.clip(rho / np.median(rho[usable]), 0.05, 20.0)
    placed = np.full(max(int(pair.hub_rows.max()) for pair in pairs) + 1, -1)
    placed[first.hub_rows[usable]] = np.flatnonzero(usable)
    poses, views = [T_first], [first.view]
    for pair in pairs:
        if pair.view == first.view:
            continue
        T = _resect(pair, placed, rays, rho)
        if T is not None:
            poses.append(T)
            views.append(pair.view)
    return _adjusted(np.stack(poses), views, pairs, first, rho, usable, K, hub)


def _triangulate(T: np.ndarray, rays: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Inverse depths [M] in the hub: least squares of xy x (R ray + rho t) = 0."""
    seen = _rays(xy)
    turned = np.cross(seen, rays @ T[:3, :3].T)
    moved = np.cross(seen, T[:3, 3])
    return -(turned * moved).sum(1) / np.maximum((moved * moved).sum(1), 1e-12)


def _resect(pair: _Pair, placed: np.ndarray, rays: np.ndarray,
            rho: np.ndarray) -> np.ndarray | None:
    """T_view_hub [4,4] of a further view from the points already placed, or None.

    placed: by hub feature, the row of its ray and rho, or -1.
    """
    rows = np.flatnonzero(placed[pair.hub_rows] >= 0)
    points = placed[pair.hub_rows[rows]]
    if len(rows) < 10:
        return None
    found, rotation, translation, inliers = cv2.solvePnPRansac(
        rays[points] / rho[points, None], pair.xy[rows], np.eye(3), None, iterationsCount=100,
        reprojectionError=0.01, flags=cv2.SOLVEPNP_SQPNP)
    if not found or inliers is None or len(inliers) < 10:
        return None
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(rotation)[0], translation[:, 0]
    return T


def _adjusted(poses: np.ndarray, views: list[int], pairs: list[_Pair], first: _Pair,
              rho: np.ndarray, usable: np.ndarray, K: Sequence[Tensor], hub: int) -> _Hypothesis:
    """Bundle adjustment over every match of the hub with the placed views."""
    placed = {view: slot for slot, view in enumerate(views)}
    used = [pair for pair in pairs if pair.view in placed]
    hub_rows = np.unique(np.concatenate([pair.hub_rows for pair in used]))
    rays = np.zeros((len(hub_rows), 3))
    for pair in used:
        at = np.searchsorted(hub_rows, pair.hub_rows)
        rays[at] = _rays(_normalised(pair.uv_hub, K[hub]))
    start = np.ones(len(hub_rows))
    start[np.searchsorted(hub_rows, first.hub_rows[usable])] = rho[usable]
    seen = Observations(
        np.concatenate([np.full(len(p.hub_rows), placed[p.view]) for p in used]),
        np.concatenate([np.searchsorted(hub_rows, p.hub_rows) for p in used]),
        np.concatenate([p.xy for p in used]), float(K[hub][0, 0]))
    adjusted = adjust(Bundle(poses, rays, start), seen, iterations=15)
    lost = sum(len(pair.uv) for pair in pairs if pair.view not in placed)
    cost = adjusted.cost + lost * float(np.log1p((_LOST_VIEW_PX / 1.5) ** 2))
    uv = np.concatenate([pair.uv for pair in used])
    return _Hypothesis(adjusted, seen, uv, views, hub_rows, cost)


def _result(best: _Hypothesis, hub: int,
            features: Sequence[ClassicalFeatures]) -> WindowPoses:
    bundle, n = best.adjusted.bundle, len(features)
    good = _well_placed(best)
    unit = float(np.median(bundle.rho[good])) if good.any() else 1.0
    T_view_hub = torch.eye(4, dtype=torch.float64).repeat(n, 1, 1)
    connected = np.zeros(n, bool)
    connected[hub] = True
    points = [SparsePoints(np.zeros((0, 2)), np.zeros(0))] * n
    points[hub] = SparsePoints(features[hub].uv[best.hub_rows[good]], unit / bundle.rho[good])
    fine = best.adjusted.residual_px < _OUTLIER_PX
    for slot, view in enumerate(best.views):
        rows = (best.seen.view == slot) & fine & good[best.seen.point]
        if rows.sum() < 10:
            continue
        T = bundle.T_view_hub[slot].copy()
        m = best.seen.point[rows]
        depth = ((bundle.rays[m] @ T[:3, :3].T)[:, 2] / bundle.rho[m] + T[2, 3]) * unit
        uv = best.uv[rows]
        points[view] = SparsePoints(uv[depth > 0], depth[depth > 0])
        T[:3, 3] *= unit
        T_view_hub[view] = torch.from_numpy(T)
        connected[view] = True
    return WindowPoses(T_view_hub[0] @ sim3.inverse(T_view_hub), connected, False, tuple(points))


def _well_placed(best: _Hypothesis) -> np.ndarray:
    """[M] bool: points with an inlier, in front, whose depth the parallax determines."""
    bundle, seen = best.adjusted.bundle, best.seen
    fine = best.adjusted.residual_px < _OUTLIER_PX
    T = bundle.T_view_hub[seen.view]
    P = np.einsum('nij,nj->ni', T[:, :3, :3], bundle.rays[seen.point]) \
        + bundle.rho[seen.point, None] * T[:, :3, 3]
    t, z = T[:, :3, 3], np.maximum(P[:, 2], 0.05)
    J = seen.focal_px * (t[:, :2] - P[:, :2] / z[:, None] * t[:, 2:]) / z[:, None]
    information = np.bincount(seen.point[fine], (J[fine] ** 2).sum(1), len(bundle.rho))
    relative = 1.0 / (np.sqrt(np.maximum(information, 1e-12)) * bundle.rho)
    return (information > 0) & (relative < _MAX_RELATIVE_SIGMA) & (bundle.rho > 2 * MIN_RHO)
