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
from .joint_residuals import PairMatches, PairResiduals

# Every eighth match is enough while rays alone bring the state near: they have the widest basin.
COARSE_STEP = 8


@dataclass(frozen=True)
class JointSolution:
    """links: [n-1,4,4] float64. kappa: reduced chi-square. iterations: steps tried."""

    links: Tensor
    kappa: float
    iterations: int


@dataclass(frozen=True)
class _Memory:
    """Earlier observations of the pairs: T_i_j [P,4,4] with information [P,7,7]."""

    T_i_j: Tensor
    information: Tensor


@dataclass(frozen=True)
class _System:
    """The whole window, linearised: equations over 7 (n-1) unknowns, the cost and kappa."""

    equations: NormalEquations
    cost: float
    kappa: float


def solve(links: Tensor, pairs: tuple[PairMatches, ...],
          config: JointTrackingConfig) -> JointSolution:
    """Optimise the links [n-1,4,4]: on thinned rays first, then on everything."""
    full = PairResiduals(pairs, config)
    coarse = full.thinned(COARSE_STEP)
    memory = _memory(pairs, coarse, config.residual)
    less = _Memory(memory.T_i_j, memory.information / COARSE_STEP)
    links, tried, _ = _Descent(pairs, coarse, less, 'ray', config).run(links)
    links, more, kappa = _Descent(pairs, full, memory, config.residual, config).run(links)
    return JointSolution(links, kappa, tried + more)


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

    def run(self, links: Tensor) -> tuple[Tensor, int, float]:
        """The optimised links, the steps tried and kappa there."""
        system, damping = self._system(links), 1e-6
        tried, limit = 0, self._config.relative_decrease
        while tried < self._config.max_iterations and damping < 1e6:
            tried += 1
            step = _step(system.equations, damping)
            if step is None:
                break
            trial = sim3.exp(step.reshape(-1, 7)) @ links
            # A step that promises next to nothing is the last one: no need to look where it ends.
            if 0.5 * float(step @ system.equations.g) < limit * system.cost:
                return trial, tried, system.kappa
            new = self._system(trial)
            if new.cost < system.cost:
                links, system, damping = trial, new, max(damping * 0.1, 1e-9)
            else:
                damping *= 100.0
        return links, tried, system.kappa

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
        H = torch.zeros(7 * len(links), 7 * len(links), dtype=torch.float64)
        g = torch.zeros(7 * len(links), dtype=torch.float64)
        for pair, chain, H_ij, g_ij in zip(self._pairs, chains, pair_H, pair_g):
            carry = sim3.adjoint(torch.stack(chain[:-1])).transpose(0, 1).reshape(7, -1)
            span = slice(7 * pair.i, 7 * pair.j)
            H[span, span] += carry.T @ H_ij @ carry
            g[span] += carry.T @ g_ij
        freedom = int(terms.rows.sum()) - len(g)
        kappa = float(terms.chi2.sum()) / freedom if freedom > 0 else math.inf
        cost = float(terms.cost.sum()) + 0.5 * float((away * pull).sum())
        return _System(NormalEquations(H, g), cost, kappa)


def _step(equations: NormalEquations, damping: float) -> Tensor | None:
    """The damped step; None where the system does not determine one."""
    damped = equations.H + torch.diag(damping * equations.H.diagonal())
    step, info = torch.linalg.solve_ex(damped, equations.g)
    return step if int(info) == 0 and bool(torch.isfinite(step).all()) else None
