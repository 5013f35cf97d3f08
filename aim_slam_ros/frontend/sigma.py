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
from ..geometry import camera, sim3
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


def candidates(index: VoxelIndex, last_id: int, config: SigmaConfig) -> tuple[int, ...]:
    """Stage 1: ids of the keyframes that share most voxels with the last one, at most top-N."""
    ids = index.overlap_of(last_id).keyframe_ids
    return tuple(ids[:config.candidates].tolist())


def rerank(last: Keyframe, candidates: Sequence[Keyframe],
           config: SigmaConfig) -> list[Ranked]:
    """Stage 2: the candidates by information gain, best first, without the last one itself.

    The gain of a candidate sums 1/2 log det P- / det P+ over the least confident points of the
    last keyframe that it sees, with P+ the Kalman update of their covariance by the candidate's
    ray. By the determinant lemma det P- / det P+ = det(R + J P J^T) / det R.
    """
    others = [kf for kf in candidates if kf.keyframe_id != last.keyframe_id]
    if not others:
        return []
    prior = _uncertain_points(last, config)
    seen = _seen_from(others, last, prior, config)
    per_point = 0.5 * torch.log(_det(seen.R + seen.predicted) / _det(seen.R))
    visible = seen.visible & torch.isfinite(per_point)
    gains = torch.where(visible, per_point, torch.zeros_like(per_point)).sum(-1)
    ranked = [Ranked(kf.keyframe_id, gain) for kf, gain in zip(others, gains.cpu().tolist())]
    return sorted(ranked, key=lambda r: (-r.gain, -r.keyframe_id))


def activate(last_id: int, candidates: Sequence[int],
             attempt: Callable[[tuple[int, ...], A | None], A],
             reorder: Callable[[A, tuple[int, ...]], Sequence[int]],
             config: SigmaConfig) -> Activation[A]:
    """Stage 3: start from config.min_window views, that is from the current frame, the last
    keyframe and the best candidate, and add while kappa asks for it.

    candidates: ids, best first; empty where there is only one keyframe. attempt: infers and
    tracks with the window's keyframe ids, given the attempt that it widens, if any. reorder: the
    remaining ids, best first, after an attempt has updated the keyframes. A window grows while
    kappa > config.kappa and each addition lowers it; the first addition that does not, takes it
    back to where it started.
    """
    remaining = tuple(k for k in candidates if k != last_id)
    beside = min(config.min_window, config.max_window) - 2
    window, remaining = (last_id, *remaining[:beside]), remaining[beside:]
    first = best = Activation(attempt(window, None), window, (window,))
    while (remaining and len(best.window) + 1 < config.max_window
           and _kappa(best.attempt) > config.kappa):
        remaining = tuple(reorder(best.attempt, remaining))
        if not remaining:
            break
        window, remaining = (*best.window, remaining[0]), remaining[1:]
        tried = (*best.tried, window)
        wider = Activation(attempt(window, best.attempt), window, tried)
        if not _kappa(wider.attempt) < _kappa(best.attempt):
            return Activation(first.attempt, first.window, tried)
        best = wider
    return best


def _kappa(attempt: Attempt) -> float:
    """An attempt that did not track fits worse than any that did."""
    return attempt.kappa if attempt.ok else float('inf')


# Points and matrices have their components first and N last, [3,N] and [3,3,N]: sums over three
# neighbours in memory cost ten times more.

@dataclass(frozen=True)
class _Uncertain:
    """points: [3,N] float64 in the last keyframe, with their covariance [3,3,N].

    typical: the confidence that one observation brings.
    """

    points: Tensor
    covariance: Tensor
    typical: float


@dataclass(frozen=True)
class _Seen:
    """How C candidates see N points. visible: [C,N].

    predicted: [C,3,3,N], the points' covariance in the candidates' rays, J P J^T, with J the
    Jacobian of the ray by the point. R: [C,3,3,N], that of the measured rays.
    """

    predicted: Tensor
    R: Tensor
    visible: Tensor


def _uncertain_points(last: Keyframe, config: SigmaConfig) -> _Uncertain:
    """The least confident of the points that the last keyframe has seen, on the grid."""
    points = last.points_cam[::config.stride, ::config.stride].reshape(-1, 3)
    confidence = last.confidence[::config.stride, ::config.stride].reshape(-1)
    usable = (points[:, 2] > 0) & torch.isfinite(points).all(-1)
    usable &= torch.isfinite(confidence) & (confidence > GUESSED_CONFIDENCE)
    points, confidence = points[usable], confidence[usable]
    confidence, least = torch.topk(confidence, min(config.points, len(points)), largest=False)
    points, confidence = points[least].double().T.contiguous(), confidence.double()
    typical = _typical(last)
    focal = last.K.diagonal()[:2].to(points)
    return _Uncertain(points, _covariance(points, confidence, typical, focal, config), typical)


def _seen_from(candidates: Sequence[Keyframe], last: Keyframe, prior: _Uncertain,
               config: SigmaConfig) -> _Seen:
    """The last keyframe's points, in the candidates' rays and their own depths there."""
    T = sim3.inverse(torch.stack([kf.T_world_kf for kf in candidates])) @ last.T_world_kf
    A, t = T[:, :3, :3].to(prior.points), T[:, :3, 3:].to(prior.points)
    X = A @ prior.points + t   # [C,3,N]
    owns = [_own(kf, X[k].T) for k, kf in enumerate(candidates)]
    own, confidence = torch.stack([o.points for o in owns]), torch.stack(
        [o.confidence for o in owns])
    # Both depths are in the candidate's unit; where they differ, something stands between.
    same = torch.log(own[:, 2] / X[:, 2]).abs() < config.depth_tolerance
    focal = torch.stack([kf.K.diagonal()[:2] for kf in candidates]).to(X)
    P = A[:, None] @ (A @ prior.covariance.flatten(1)).unflatten(2, (3, -1))   # A P A^T
    R = _on_rays(_covariance(own, confidence, prior.typical, focal, config), own)
    # A ray has two degrees of freedom: the floor keeps R invertible along it.
    R[:, [0, 1, 2], [0, 1, 2]] += config.sigma_ray ** 2
    return _Seen(_on_rays(P, X), R, same & (confidence > GUESSED_CONFIDENCE))


@dataclass(frozen=True)
class _Own:
    """A candidate's points [3,N] and their confidence [N], 0 outside its image."""

    points: Tensor
    confidence: Tensor


def _own(candidate: Keyframe, X: Tensor) -> _Own:
    """Where points X [N,3] in its camera frame appear."""
    uv = camera.project(X, candidate.K)
    height, width = candidate.confidence.shape
    inside = camera.inside(uv, height, width)
    at = torch.where(inside[:, None], uv, torch.zeros_like(uv)).round().long()
    at = at[:, 1] * width + at[:, 0]
    own = candidate.points_cam.reshape(-1, 3).index_select(0, at)
    confidence = candidate.confidence.reshape(-1).index_select(0, at)
    return _Own(own.to(X).T, confidence.to(X) * inside)


def _covariance(points: Tensor, confidence: Tensor, typical: float, focal: Tensor,
                config: SigmaConfig) -> Tensor:
    """Pixel and depth noise through the inverse projection z K^-1 (u, v, 1): [...,3,3,N].

    points: [...,3,N]. confidence: [...,N], above 1 and accumulated over observations; ``typical``
    is what a single observation adds to it, for the unit of a model's confidence is its own.
    focal: [...,2].
    """
    across = config.sigma_px * points[..., 2:, :] / focal[..., None]
    along = points * (config.sigma_depth * (typical / (confidence - 1.0)).sqrt())[..., None, :]
    covariance = along[..., :, None, :] * along[..., None, :, :]
    covariance[..., [0, 1], [0, 1], :] += across.square()
    return covariance


def _on_rays(covariance: Tensor, points: Tensor) -> Tensor:
    """D M D^T [...,3,3,N] of covariances M of points [...,3,N]; D = dr/dX = (I - r r^T)/|X|.

    (I - r r^T) M (I - r r^T) = M - r a^T - a r^T with a = M r - (r^T M r) r / 2.
    """
    d2 = points.square().sum(-2, keepdim=True)
    r = points * d2.rsqrt()
    Mr = (covariance * r[..., None, :, :]).sum(-2)
    a = Mr - 0.5 * (r * Mr).sum(-2, keepdim=True) * r
    cross = r[..., :, None, :] * a[..., None, :, :]
    return (covariance - cross - cross.transpose(-3, -2)) / d2[..., None, :]


def _typical(keyframe: Keyframe) -> float:
    """The median confidence above 1 that one observation brought to the keyframe."""
    confidence = keyframe.confidence[::4, ::4]   # a median needs no more
    seen = confidence[torch.isfinite(confidence) & (confidence > GUESSED_CONFIDENCE)]
    return float(seen.median() - 1.0) / keyframe.observations if len(seen) else 1.0


def _det(M: Tensor) -> Tensor:
    """Determinants [...,N] of [...,3,3,N], without a decomposition per point."""
    a, b, c = M.unbind(-3)
    return (a * torch.linalg.cross(b, c, dim=-2)).sum(-2)
