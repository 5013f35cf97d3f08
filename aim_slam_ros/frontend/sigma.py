"""SIGMA: which keyframes join the current frame in an inference (paper, adaptive prioritisation).

Three stages: candidates by voxel overlap, their order by information gain, and how many of them
by a chi-square test. Everything is asked of the last keyframe, not of the current frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Callable, Generic, Protocol, Sequence, TypeVar

import torch
from torch import Tensor

from ..config import SigmaConfig
from ..geometry import camera, rays, sim3
from ..types import GUESSED_CONFIDENCE, Keyframe
from .voxel_index import VoxelIndex


@dataclass(frozen=True)
class Ranked:
    """gain: information [nat] that the keyframe adds to the points of the last one."""

    keyframe_id: int
    gain: float


class Attempt(Protocol):
    """One inference and optimisation over a window."""

    @property
    def ok(self) -> bool:
        """Whether the frame was placed."""

    @property
    def kappa(self) -> float:
        """Its reduced chi-square."""


A = TypeVar('A', bound=Attempt)


@dataclass(frozen=True)
class Activation(Generic[A]):
    """The attempt that was kept. window: its keyframe ids; tried: those of every attempt made."""

    attempt: A
    window: tuple[int, ...]
    tried: tuple[tuple[int, ...], ...]


def candidates(index: VoxelIndex, last_id: int, config: SigmaConfig,
               exclude: tuple[int, ...] = ()) -> tuple[int, ...]:
    """Stage 1: ids of the keyframes that share most voxels with the last one, at most top-N."""
    ids = index.overlap_of(last_id, exclude).keyframe_ids
    return tuple(ids[:config.candidates].tolist())


def rerank(last: Keyframe, candidates: Sequence[Keyframe], config: SigmaConfig,
           exclude: tuple[int, ...] = ()) -> list[Ranked]:
    """Stage 2: the candidates by information gain, best first, without those excluded.

    The gain of a candidate sums 1/2 log det P- / det P+ over the least confident points of the
    last keyframe that it sees, with P+ the Kalman update of their covariance by the candidate's
    ray. By the determinant lemma det P- / det P+ = det(R + J P J^T) / det R.
    """
    others = [kf for kf in candidates
              if kf.keyframe_id != last.keyframe_id and kf.keyframe_id not in exclude]
    if not others:
        return []
    prior = _uncertain_points(last, config)
    seen = [_seen_from(kf, last, prior, config) for kf in others]
    J = torch.stack([view.J for view in seen])   # [C,N,3,3]
    R = torch.stack([view.R for view in seen])
    per_point = 0.5 * torch.log(_det(R + J @ prior.covariance @ J.mT) / _det(R))
    visible = torch.stack([view.visible for view in seen]) & torch.isfinite(per_point)
    gains = torch.where(visible, per_point, torch.zeros_like(per_point)).sum(-1)
    ranked = [Ranked(kf.keyframe_id, float(gain)) for kf, gain in zip(others, gains)]
    return sorted(ranked, key=lambda r: (-r.gain, -r.keyframe_id))


def activate(last_id: int, candidates: Sequence[int],
             attempt: Callable[[tuple[int, ...]], A],
             reorder: Callable[[A, tuple[int, ...]], Sequence[int]],
             config: SigmaConfig) -> Activation[A]:
    """Stage 3: start from the last keyframe and the best candidate, add while kappa asks for it.

    candidates: ids, best first; empty where there is only one keyframe. attempt: infers and
    tracks with the window's keyframe ids. reorder: the remaining ids, best first, after an
    attempt has updated the keyframes. A window grows while kappa > config.kappa and each addition
    lowers it; the first addition that does not, takes it back to where it started.
    """
    remaining = tuple(k for k in candidates if k != last_id)
    window = (last_id, *remaining[:1]) if config.max_window > 2 else (last_id,)
    remaining = remaining[1:]
    first = best = Activation(attempt(window), window, (window,))
    while (remaining and len(best.window) + 1 < config.max_window
           and _kappa(best.attempt) > config.kappa):
        remaining = tuple(reorder(best.attempt, remaining))
        if not remaining:
            break
        window, remaining = (*best.window, remaining[0]), remaining[1:]
        tried = (*best.tried, window)
        wider = Activation(attempt(window), window, tried)
        if not _kappa(wider.attempt) < _kappa(best.attempt):
            return Activation(first.attempt, first.window, tried)
        best = wider
    return best


def _kappa(attempt: Attempt) -> float:
    """An attempt that did not track fits worse than any that did."""
    return attempt.kappa if attempt.ok else float('inf')


@dataclass(frozen=True)
class _Uncertain:
    """points: [N,3] float64 in the last keyframe, with their covariance [N,3,3].

    typical: the confidence that one observation brings.
    """

    points: Tensor
    covariance: Tensor
    typical: float


@dataclass(frozen=True)
class _Seen:
    """How a candidate sees N points. J: [N,3,3] ray by point; R: [N,3,3]; visible: [N] bool."""

    J: Tensor
    R: Tensor
    visible: Tensor


def _uncertain_points(last: Keyframe, config: SigmaConfig) -> _Uncertain:
    """The least confident of the points that the last keyframe has seen, on the grid."""
    points = last.points_cam[::config.stride, ::config.stride].reshape(-1, 3).double()
    confidence = last.confidence[::config.stride, ::config.stride].reshape(-1).double()
    usable = (points[:, 2] > 0) & torch.isfinite(points).all(-1)
    usable &= torch.isfinite(confidence) & (confidence > GUESSED_CONFIDENCE)
    points, confidence = points[usable], confidence[usable]
    count = min(config.points, len(points))
    confidence, least = torch.topk(confidence, count, largest=False)
    points = points[least]
    typical = _typical(last)
    return _Uncertain(points, _covariance(points, confidence, typical, last.K, config), typical)


def _seen_from(candidate: Keyframe, last: Keyframe, prior: _Uncertain,
               config: SigmaConfig) -> _Seen:
    """The last keyframe's points, in the candidate's rays and its own depth there."""
    T = sim3.inverse(candidate.T_world_kf) @ last.T_world_kf
    X = sim3.transform(T, prior.points)
    uv = camera.project(X, candidate.K)
    height, width = candidate.confidence.shape
    inside = camera.inside(uv, height, width)
    at = torch.where(inside[:, None], uv, torch.zeros_like(uv)).round().long()
    own = candidate.points_cam[at[:, 1], at[:, 0]].double()
    confidence = candidate.confidence[at[:, 1], at[:, 0]].double()
    # Both depths are in the candidate's unit; where they differ, something stands between.
    same = torch.log(own[:, 2] / X[:, 2]).abs() < config.depth_tolerance
    visible = inside & same & (confidence > GUESSED_CONFIDENCE)
    to_ray = rays.ray_derivative(own)
    noise = _covariance(own, confidence, prior.typical, candidate.K, config)
    floor = config.sigma_ray ** 2 * torch.eye(3, dtype=X.dtype, device=X.device)
    # A ray has two degrees of freedom: the floor keeps R invertible along it.
    return _Seen(rays.ray_derivative(X) @ T[:3, :3].to(X), to_ray @ noise @ to_ray.mT + floor,
                 visible)


def _covariance(points: Tensor, confidence: Tensor, typical: float, K: Tensor,
                config: SigmaConfig) -> Tensor:
    """Pixel and depth noise through the inverse projection z K^-1 (u, v, 1): [N,3,3].

    points: [N,3]. confidence: [N], above 1 and accumulated over observations; ``typical`` is what
    a single observation adds to it, for the unit of a model's confidence is its own.
    """
    z = points[:, 2]
    J = points.new_zeros(len(points), 3, 3)
    J[:, 0, 0], J[:, 1, 1] = z / K[0, 0], z / K[1, 1]
    J[:, :, 2] = points / z[:, None]
    pixel = torch.full_like(z, config.sigma_px ** 2)
    depth = (config.sigma_depth * z).square() * typical / (confidence - 1.0)
    return (J * torch.stack([pixel, pixel, depth], -1)[:, None, :]) @ J.mT


def _typical(keyframe: Keyframe) -> float:
    """The median confidence above 1 that one observation brought to the keyframe."""
    confidence = keyframe.confidence[::4, ::4]   # a median needs no more
    seen = confidence[torch.isfinite(confidence) & (confidence > GUESSED_CONFIDENCE)]
    return float(seen.median() - 1.0) / keyframe.observations if len(seen) else 1.0


def _det(M: Tensor) -> Tensor:
    """Determinants [...] of [...,3,3], without a decomposition per point."""
    return (M[..., 0, :] * torch.linalg.cross(M[..., 1, :], M[..., 2, :])).sum(-1)
