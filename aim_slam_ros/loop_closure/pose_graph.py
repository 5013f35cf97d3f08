"""Sim(3) pose graph on GTSAM: the only file that knows GTSAM and its convention.

GTSAM's Similarity3 acts as ``s (R p + t)``, its tangent is (rotation, translation, log-scale) and
it perturbs on the right; ours acts as ``s R p + t`` with (translation, rotation, log-scale) on the
left. The generators differ only by a multiple of the identity, so the same seven numbers,
permuted, describe the same transform; covariances cross over by the adjoint.
"""

from __future__ import annotations

from typing import Sequence

import gtsam
import numpy as np
import torch
from torch import Tensor

from ..geometry import sim3
from ..types import PoseEdge

# (rotation, translation, log-scale) out of (translation, rotation, log-scale), and back.
_ORDER = [3, 4, 5, 0, 1, 2, 6]
# A prior only fixes the gauge; its stiffness is arbitrary as nothing pulls against it.
_PRIOR_SIGMA = 1e-4
_ANNEALING = 4.0


class PoseGraphError(ValueError):
    """A keyframe or an edge that the graph cannot take."""


def to_gtsam(T: Tensor) -> gtsam.Similarity3:
    """T_a_b [4,4] as GTSAM's Similarity3 of the same action."""
    scale = float(sim3.scale_of(T))
    translation = (sim3.translation_of(T) / scale).numpy()
    return gtsam.Similarity3(gtsam.Rot3(sim3.rotation_of(T).numpy()), translation, scale)


def from_gtsam(S: gtsam.Similarity3) -> Tensor:
    """[4,4] float64; the inverse of ``to_gtsam``."""
    scale = float(S.scale())
    return sim3.from_parts(scale, torch.from_numpy(S.rotation().matrix()),
                           torch.from_numpy(scale * S.translation()))


def to_gtsam_covariance(T: Tensor, sigma: Tensor) -> np.ndarray:
    """[7,7] float64: sigma [7] of T's left perturbation as GTSAM's right-hand covariance.

    exp(xi) T = T exp(Ad(T^-1) xi).
    """
    Ad = sim3.adjoint(sim3.inverse(T))
    covariance: np.ndarray = (Ad @ torch.diag(sigma ** 2) @ Ad.T).numpy()
    return covariance[np.ix_(_ORDER, _ORDER)]


def _between(edge: PoseEdge) -> gtsam.BetweenFactorSimilarity3:
    noise = gtsam.noiseModel.Gaussian.Covariance(to_gtsam_covariance(edge.T_a_b, edge.sigma))
    return gtsam.BetweenFactorSimilarity3(edge.a, edge.b, to_gtsam(edge.T_a_b), noise)


class PoseGraph:
    """Keyframe poses and the edges between them.

    Keyframes joined by edges form a component; each component is held at its oldest keyframe, so
    that disconnected map pieces stay solvable and keep the worlds they were born in.
    """

    def __init__(self, cauchy_width: float = 1.0) -> None:
        """cauchy_width: whitened residual at which a robust edge has lost half its weight."""
        self._cauchy_width = cauchy_width
        self._values = gtsam.Values()
        self._trusted = gtsam.NonlinearFactorGraph()
        self._robust: list[gtsam.BetweenFactorSimilarity3] = []
        self._neighbours: dict[int, list[int]] = {}
        self._component: dict[int, int] = {}
        self._edges: list[tuple[int, int]] = []

    def __contains__(self, keyframe_id: int) -> bool:
        return keyframe_id in self._neighbours

    def add_keyframe(self, keyframe_id: int, T_world_kf: Tensor) -> None:
        """Raises PoseGraphError for a known id or a pose that is not finite."""
        if keyframe_id in self:
            raise PoseGraphError(f'keyframe {keyframe_id} is in the graph already; '
                                 'keyframe ids must never be reused')
        self._values.insert(keyframe_id, to_gtsam(_checked_pose(keyframe_id, T_world_kf)))
        self._neighbours[keyframe_id] = []
        self._component[keyframe_id] = keyframe_id

    def move(self, keyframe_id: int, T_world_kf: Tensor) -> None:
        """Replace a pose: the point from which the next optimisation starts."""
        self._values.update(keyframe_id, to_gtsam(_checked_pose(keyframe_id, T_world_kf)))

    def add_edge(self, edge: PoseEdge, robust: bool) -> None:
        """Add a measurement between two known keyframes.

        A robust (loop) edge between two components carries the newer one rigidly into the
        world of the older. Raises PoseGraphError for unknown ends or useless numbers.
        """
        self._check(edge)
        if robust:
            self._robust.append(_between(edge))
        else:
            self._trusted.add(_between(edge))
        self._edges.append((edge.a, edge.b))
        self._neighbours[edge.a].append(edge.b)
        self._neighbours[edge.b].append(edge.a)
        if self._component[edge.a] != self._component[edge.b]:
            self._join(edge, carry=robust)

    def pose(self, keyframe_id: int) -> Tensor:
        """T_world_kf [4,4] float64."""
        return from_gtsam(self._values.atSimilarity3(keyframe_id))

    def poses(self) -> dict[int, Tensor]:
        """T_world_kf of every keyframe, in the order they were added."""
        return {keyframe_id: self.pose(keyframe_id) for keyframe_id in self._neighbours}

    def chained(self, keyframe_id: int, edges: Sequence[PoseEdge]) -> Tensor | None:
        """T_world_kf [4,4] of a new keyframe from its edges to known ones; None without any.

        The mean of what the edges say, weighted by their precision.
        """
        known = [e for e in edges if e.b == keyframe_id and e.a in self]
        if not known:
            return None
        guesses = torch.stack([self.pose(e.a) @ e.T_a_b for e in known])
        return sim3.mean(guesses, torch.stack([1.0 / (e.sigma ** 2).sum() for e in known]))

    @property
    def edges(self) -> tuple[tuple[int, int], ...]:
        """The two keyframes of every edge, in the order they were added."""
        return tuple(self._edges)

    @property
    def components(self) -> dict[int, int]:
        """The oldest keyframe that each keyframe is connected with."""
        return dict(self._component)

    def neighbours(self, keyframe_id: int) -> tuple[int, ...]:
        """Keyframes that share an edge with this one, the first linked first."""
        return tuple(dict.fromkeys(self._neighbours[keyframe_id]))

    def within(self, keyframe_id: int, hops: int) -> set[int]:
        """Keyframes at most this many edges away, itself among them."""
        reached = frontier = {keyframe_id}
        for _ in range(hops):
            frontier = {n for k in frontier for n in self._neighbours[k]} - reached
            reached = reached | frontier
        return reached

    def neighbourhood(self, keyframe_id: int, hops: int, gap: int) -> set[int]:
        """Keyframes that may see the same without any loop: some edges away, or close in time.

        gap: in keyframes, by their ids, which count up in time whenever they arrive; those of
        another component do not count as close in time.
        """
        own = self._component[keyframe_id]
        close = range(keyframe_id - gap + 1, keyframe_id + gap)
        return self.within(keyframe_id, hops) | {
            k for k in close if self._component.get(k) == own}

    @staticmethod
    def is_long(edge: PoseEdge, gap: int) -> bool:
        """Whether more keyframes than ``gap`` came between the ends: a loop in all but name."""
        return abs(edge.a - edge.b) > gap

    def optimise(self) -> dict[int, Tensor]:
        """Batch Levenberg-Marquardt from the present poses; every T_world_kf [4,4] float64.

        Cauchy on the robust edges, its width annealed from their largest residual down: seen
        through the final width at once, a true loop with much drift would look like a false one.
        """
        for width in self._widths():
            graph = gtsam.NonlinearFactorGraph(self._trusted)
            self._hold_components(graph)
            estimator = gtsam.noiseModel.mEstimator.Cauchy.Create(width)
            for factor in self._robust:
                noise = gtsam.noiseModel.Robust.Create(estimator, factor.noiseModel())
                a, b = factor.keys()
                graph.add(gtsam.BetweenFactorSimilarity3(a, b, factor.measured(), noise))
            optimiser = gtsam.LevenbergMarquardtOptimizer(graph, self._values)
            self._values = optimiser.optimize()
        return self.poses()

    def _widths(self) -> list[float]:
        residuals = [(2.0 * f.error(self._values)) ** 0.5 for f in self._robust]
        widths = [max([self._cauchy_width, *residuals])]
        while widths[-1] > self._cauchy_width:
            widths.append(max(self._cauchy_width, widths[-1] / _ANNEALING))
        return widths

    def _hold_components(self, graph: gtsam.NonlinearFactorGraph) -> None:
        noise = gtsam.noiseModel.Isotropic.Sigma(7, _PRIOR_SIGMA)
        for root in set(self._component.values()):
            value = self._values.atSimilarity3(root)
            graph.add(gtsam.PriorFactorSimilarity3(root, value, noise))

    def _join(self, edge: PoseEdge, carry: bool) -> None:
        a_is_older = self._component[edge.a] < self._component[edge.b]
        old, new = (edge.a, edge.b) if a_is_older else (edge.b, edge.a)
        T_old_new = edge.T_a_b if a_is_older else sim3.inverse(edge.T_a_b)
        root, absorbed = self._component[old], self._component[new]
        T_correction = self.pose(old) @ T_old_new @ sim3.inverse(self.pose(new))
        for keyframe_id in [k for k, c in self._component.items() if c == absorbed]:
            self._component[keyframe_id] = root
            if carry:
                self.move(keyframe_id, T_correction @ self.pose(keyframe_id))

    def _check(self, edge: PoseEdge) -> None:
        unknown = [k for k in (edge.a, edge.b) if k not in self]
        if unknown or edge.a == edge.b:
            raise PoseGraphError(f'edge {edge.a}-{edge.b} needs two different keyframes of the '
                                 f'graph (unknown: {unknown}); add the keyframes first')
        _checked_pose(edge.b, edge.T_a_b)
        if edge.sigma.shape != (7,) or not bool((edge.sigma > 0).all()) \
                or not bool(edge.sigma.isfinite().all()):
            raise PoseGraphError(f'edge {edge.a}-{edge.b} has sigma {edge.sigma.tolist()}; '
                                 'it must be 7 positive, finite numbers')


def _checked_pose(keyframe_id: int, T: Tensor) -> Tensor:
    if T.shape != (4, 4) or not bool(T.isfinite().all()) or float(torch.linalg.det(T)) <= 0:
        raise PoseGraphError(f'the pose of keyframe {keyframe_id} is not a Sim(3): {T.tolist()}')
    return T.to(torch.float64)
