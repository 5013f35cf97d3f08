"""The residuals of all pairs of a window, linearised together (paper, hybrid residual).

All pairs are padded to one length and handled as one batch: with a dozen small operations per
pair the overhead of each would cost more than its arithmetic.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ..config import JointTrackingConfig
from ..geometry import rays
from ..geometry.rays import NormalEquations


@dataclass(frozen=True)
class PairMatches:
    """Matches of view j (later) in view i (earlier); i, j index the window in temporal order.

    points_j, points_i: [N,3] matched points, each in its own view's frame and unit.
    q: [N] confidence weights, mean 1. K_i: [3,3]. diagonal_px: of the image. depth_i: median depth
    of view i, in its unit. T_i_j: [4,4], where earlier observations put the pair; observations:
    how many of them, None for a pair with the current frame, which has no past.
    """

    i: int
    j: int
    points_j: Tensor
    points_i: Tensor
    q: Tensor
    K_i: Tensor
    diagonal_px: float
    depth_i: float
    T_i_j: Tensor
    observations: float | None


@dataclass(frozen=True)
class PairTerms:
    """P pairs, linearised: equations [P,7,7], [P,7]; cost [P] with Huber.

    information: [P,7,7] of the independent data alone. chi2: [P] of them, without Huber, over
    ``rows`` [P]. Rays and projections are the same data twice: of hybrid only the rays count.
    """

    equations: NormalEquations
    information: Tensor
    cost: Tensor
    chi2: Tensor
    rows: Tensor


@dataclass(frozen=True)
class _Whitened:
    """weight: [P,N] IRLS, inverse variance. cost: [P]. chi2: [P]."""

    weight: Tensor
    cost: Tensor
    chi2: Tensor


class PairResiduals:
    """Rays or projections or both, and always log-distances, of a batch of pairs."""

    def __init__(self, pairs: tuple[PairMatches, ...], config: JointTrackingConfig) -> None:
        self._config = config
        self._points_j = _padded([pair.points_j for pair in pairs])   # [P,3,N]
        points_i = _padded([pair.points_i for pair in pairs])
        self._q = _padded([pair.q[:, None] for pair in pairs], 0.0)[:, 0]   # [P,N]
        K = torch.stack([pair.K_i for pair in pairs]).to(points_i)
        self._focal, self._centre = torch.stack([K[:, 0, 0], K[:, 1, 1]], -1), K[:, :2, 2]
        self._diagonal_px = max(pair.diagonal_px for pair in pairs)
        distance = points_i.norm(dim=1)
        self._rays_i, self._log_i = points_i / distance[:, None], distance.log()
        self._uv_i = self._projected(points_i)

    def thinned(self, step: int) -> PairResiduals:
        """Every ``step``-th match."""
        thin = object.__new__(PairResiduals)
        thin.__dict__.update({name: value[..., ::step].contiguous()
                              if name in ('_points_j', '_q', '_rays_i', '_log_i', '_uv_i')
                              else value for name, value in self.__dict__.items()})
        return thin

    def linearise(self, T_i_j: Tensor, kind: str) -> PairTerms:
        """The terms at T_i_j [P,4,4]; kind: 'ray', 'projection' or 'hybrid'."""
        config, T = self._config, T_i_j.to(self._points_j)
        X = T[:, :3, :3] @ self._points_j + T[:, :3, 3:]
        d2 = X.square().sum(1)
        # Behind the camera a point costs a constant: it must not pay to go there.
        front = X[:, 2] > 0.01 * d2.sqrt()
        X = torch.where(front[:, None], X, torch.ones_like(X))
        q = torch.where(front, self._q, torch.zeros_like(self._q))
        d2 = X.square().sum(1)
        e_log = self._log_i - 0.5 * d2.log()
        e_ray = self._rays_i - X * d2.rsqrt()[:, None]
        by_log = self._whitened(e_log.square(), q, config.sigma_log_distance)
        by_ray = self._whitened(e_ray.square().sum(1), q, config.sigma_ray)
        ray_weight = torch.zeros_like(q) if kind == 'projection' else by_ray.weight
        equations = rays.ray_normal_equations(X, e_ray, e_log, ray_weight, by_log.weight)
        information = equations.H
        cost, chi2 = by_log.cost, by_log.chi2
        if kind != 'projection':
            cost = cost + by_ray.cost
        if kind != 'ray':
            e_px = self._uv_i - self._projected(X)
            by_px = self._whitened(e_px.square().sum(1), q, config.sigma_pixel)
            equations = equations + rays.pixel_normal_equations(
                X, e_px, by_px.weight, self._focal)
            cost = cost + by_px.cost
        if kind == 'projection':
            information = equations.H
        chi2 = chi2 + (by_px.chi2 if kind == 'projection' else by_ray.chi2)
        used = self._q > 0
        behind = (used & ~front).sum(-1)
        return PairTerms(equations, information, cost + behind * self._cost_behind(kind), chi2,
                         3 * (used & front).sum(-1))

    def _whitened(self, squared: Tensor, q: Tensor, sigma: float) -> _Whitened:
        """squared: [P,N] squared length of the errors."""
        k = self._config.huber
        squared = squared * q / sigma ** 2
        s = squared.sqrt()
        inside = s.clamp_max(k)
        # Huber in one line: s^2/2 up to k, then k s - k^2/2.
        cost = (inside * (s - 0.5 * inside)).sum(-1, dtype=torch.float64)
        weight = q / sigma ** 2 * (k / s.clamp_min(k))
        return _Whitened(weight, cost, squared.sum(-1, dtype=torch.float64))

    def _projected(self, points: Tensor) -> Tensor:
        """Points [P,3,N] with z > 0 to pixels [P,2,N]."""
        return (points[:, :2] / points[:, 2:] * self._focal[..., None] + self._centre[..., None])

    def _cost_behind(self, kind: str) -> float:
        """More than a point in front of the camera pays for its direction."""
        k, cost = self._config.huber, 0.0
        if kind != 'projection':
            cost += k * 2.0 / self._config.sigma_ray
        if kind != 'ray':
            cost += k * self._diagonal_px / self._config.sigma_pixel
        return cost


def _padded(parts: list[Tensor], value: float = 1.0) -> Tensor:
    """P tensors [n,C] to [P,C,N]; at least one column."""
    size = max(1, max(len(part) for part in parts))
    out = parts[0].new_full((len(parts), parts[0].shape[1], size), value)
    for row, part in zip(out, parts):
        row[:, :len(part)] = part.T
    return out
