"""Levenberg-Marquardt over the adjacent relative Sim(3) of a window (paper, joint optimisation).

The state is one link T^k_{k+1} per two neighbouring views; a pair (i, j) further apart sees the
product of its links, and its equations are carried to each of them by the adjoint.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ..config import JointTrackingConfig
from ..geometry import sim3
from ..geometry.rays import NormalEquations
from .joint_residuals import PairMatches, PairResiduals, PairTerms

# Every eighth match is enough while rays alone bring the state near: they have the widest basin.
COARSE_STEP = 8


@dataclass(frozen=True)
class JointSolution:
    """links: [n-1,4,4] float64. kappa: reduced chi-square.

    information: [7(n-1),7(n-1)] float64 of the links under left perturbations, what is remembered
    included; its inverse is their covariance as far as the sigmas are honest. It has Huber's
    weights, so that it is some 4 % too modest under Gaussian noise.
    """

    links: Tensor
    kappa: float
    information: Tensor


@dataclass(frozen=True)
class _Memory:
    """Earlier observations of the pairs: T_i_j [P,4,4] with information [P,7,7]."""

    T_i_j: Tensor
    information: Tensor


@dataclass(frozen=True)
class _System:
    """The whole window, linearised: equations over 7 (n-1) unknowns, and the cost.

    carries: [7,7(j-i)] of each pair, from its links' perturbations to its own. terms: the pairs.
    """

    equations: NormalEquations
    cost: float
    carries: tuple[Tensor, ...]
    terms: PairTerms


@dataclass(frozen=True)
class _Descended:
    """links: [n-1,4,4]. system: where it was linearised last."""

    links: Tensor
    system: _System


def solve(links: Tensor, pairs: tuple[PairMatches, ...],
          config: JointTrackingConfig) -> JointSolution:
    """Optimise the links [n-1,4,4]: on thinned rays first, then on everything."""
    full = PairResiduals(pairs, config)
    coarse = full.thinned(COARSE_STEP)
    memory = _memory(pairs, coarse, config.residual)
    less = _Memory(memory.T_i_j, memory.information / COARSE_STEP)
    near = _Descent(pairs, coarse, less, 'ray', config).run(links)
    end = _Descent(pairs, full, memory, config.residual, config).run(near.links)
    data = _assembled(pairs, end.system.carries, end.system.terms.information.cpu())
    remembered = _assembled(pairs, end.system.carries, memory.information)
    return JointSolution(end.links, _kappa(end.system.terms, data), data + remembered)


def _memory(pairs: tuple[PairMatches, ...], coarse: PairResiduals, kind: str) -> _Memory:
    """Each earlier observation of a pair weighs as much as today's."""
    T = torch.stack([pair.T_i_j for pair in pairs])
    H = coarse.linearise(T, kind).equations.H.cpu() * COARSE_STEP
    information = torch.zeros_like(H)
    for k, pair in enumerate(pairs):
        if pair.observations is not None:
            # A link without matches still has to be held: weakly, at 10 % of everything.
            weak = torch.full((7,), 100.0, dtype=H.dtype)
            weak[:3] /= pair.depth_i ** 2
            information[k] = pair.observations * H[k] + torch.diag(weak)
    return _Memory(T, information)


class _Descent:
    """One Levenberg-Marquardt run over one kind of residual."""

    def __init__(self, pairs: tuple[PairMatches, ...], residuals: PairResiduals, memory: _Memory,
                 kind: str, config: JointTrackingConfig) -> None:
        self._pairs, self._residuals, self._memory = pairs, residuals, memory
        self._kind, self._config = kind, config

    def run(self, links: Tensor) -> _Descended:
        """Until a step would gain next to nothing."""
        system, damping = self._system(links), 1e-6
        limit = self._config.relative_decrease
        for _ in range(self._config.max_iterations):
            step = _step(system.equations, damping)
            if step is None:
                break
            trial = sim3.exp(step.reshape(-1, 7)) @ links
            # A step that promises next to nothing is the last one: no need to look where it ends.
            if 0.5 * float(step @ system.equations.g) < limit * system.cost:
                return _Descended(trial, system)
            new = self._system(trial)
            if new.cost < system.cost:
                links, system, damping = trial, new, max(damping * 0.1, 1e-9)
            else:
                damping *= 100.0
                if damping >= 1e6:
                    break
        return _Descended(links, system)

    def _system(self, links: Tensor) -> _System:
        """Perturbed links move a pair by delta_ij = sum over k of Ad(T_i_k) delta_k."""
        chains = [list(itertools.accumulate(links[pair.i:pair.j], torch.matmul,
                                            initial=sim3.identity())) for pair in self._pairs]
        T_i_j = torch.stack([chain[-1] for chain in chains])
        terms = self._residuals.linearise(T_i_j, self._kind)
        away = sim3.log(self._memory.T_i_j @ sim3.inverse(T_i_j))
        pull = (self._memory.information @ away[..., None])[..., 0]
        pair_H = terms.equations.H.cpu() + self._memory.information
        pair_g = terms.equations.g.cpu() + pull
        carries = tuple(sim3.adjoint(torch.stack(chain[:-1])).transpose(0, 1).reshape(7, -1)
                        for chain in chains)
        g = torch.zeros(7 * len(links), dtype=torch.float64)
        for pair, carry, g_ij in zip(self._pairs, carries, pair_g):
            g[7 * pair.i:7 * pair.j] += carry.T @ g_ij
        cost = float(terms.cost.sum()) + 0.5 * float((away * pull).sum())
        return _System(NormalEquations(_assembled(self._pairs, carries, pair_H), g), cost,
                       carries, terms)


def _assembled(pairs: tuple[PairMatches, ...], carries: tuple[Tensor, ...],
               pair_H: Tensor) -> Tensor:
    """The pairs' matrices [P,7,7], each on the links that it spans: [7(n-1),7(n-1)]."""
    size = 7 * max(pair.j for pair in pairs)
    H = torch.zeros(size, size, dtype=torch.float64)
    for pair, carry, H_ij in zip(pairs, carries, pair_H):
        span = slice(7 * pair.i, 7 * pair.j)
        H[span, span] += carry.T @ H_ij @ carry
    return H


def _kappa(terms: PairTerms, information: Tensor) -> float:
    """Chi-square over M - rank(A): a link that no match sees is no unknown."""
    scale = information.diagonal().clamp_min(1e-300).rsqrt()
    values = torch.linalg.eigvalsh(scale[:, None] * information * scale)
    freedom = int(terms.rows.sum()) - int((values > 1e-9 * values[-1].clamp_min(1e-300)).sum())
    return float(terms.chi2.sum()) / freedom if freedom > 0 else math.inf


def _step(equations: NormalEquations, damping: float) -> Tensor | None:
    """The damped step; None where the system does not determine one."""
    damped = equations.H + torch.diag(damping * equations.H.diagonal())
    step, info = torch.linalg.solve_ex(damped, equations.g)
    return step if int(info) == 0 and bool(torch.isfinite(step).all()) else None
