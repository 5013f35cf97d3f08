"""Dense depth of one view by a plane sweep, at a quarter of the resolution."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

_BOX = 9
_TRUNCATION = 60.0   # grey levels; also what a pixel outside a source costs


@dataclass(frozen=True)
class Source:
    """small: [h,w] uint8, contrast-normalised; K, T_source_ref for the small images."""

    small: np.ndarray
    K: np.ndarray
    T_source_ref: np.ndarray


@dataclass(frozen=True)
class SweepDepth:
    """rho: [h,w] float32 inverse depth. score: [h,w] float32 in 0..1, cost times uniqueness."""

    rho: np.ndarray
    score: np.ndarray


def sweep(small: np.ndarray, K: np.ndarray, sources: list[Source], rho_range: tuple[float, float],
          planes: int) -> SweepDepth:
    """Compare the view with its sources warped over planes of constant inverse depth."""
    rhos = np.linspace(rho_range[0], rho_range[1], planes)
    volume = np.stack([_costs(small, K, source, rhos) for source in sources])
    cost = volume[0] if len(sources) == 1 else _mean_of_best(volume)
    best = cost.argmin(0)
    lowest = np.take_along_axis(cost, best[None], 0)[0]
    rho = rhos[0] + (best + _parabola(cost, best)) * (rhos[1] - rhos[0])
    score = np.exp(-(lowest / 25.0) ** 2) * _uniqueness(cost, best, lowest)
    score[(best == 0) | (best == planes - 1)] *= 0.2   # at the end of the range: maybe outside it
    return SweepDepth(np.maximum(rho, 1e-4).astype(np.float32), score.astype(np.float32))


def _costs(small: np.ndarray, K: np.ndarray, source: Source, rhos: np.ndarray) -> np.ndarray:
    """[D,h,w] float32: truncated absolute difference, averaged over a box."""
    h, w = small.shape
    K_inv = np.linalg.inv(K)
    turn = source.K @ source.T_source_ref[:3, :3] @ K_inv
    move = np.outer(source.K @ source.T_source_ref[:3, 3], K_inv[2])
    out = np.empty((len(rhos), h, w), np.float32)
    for d, rho in enumerate(rhos):
        warped = cv2.warpPerspective(source.small, turn + rho * move, (w, h),
                                     flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
        difference = cv2.absdiff(small, warped)
        np.minimum(difference, int(_TRUNCATION), out=difference)
        difference[warped == 0] = int(_TRUNCATION)   # 0 is kept free for 'outside'
        cv2.boxFilter(difference, cv2.CV_32F, (_BOX, _BOX), dst=out[d])
    return out


def _mean_of_best(volume: np.ndarray) -> np.ndarray:
    """Mean without the highest cost: an occlusion in one source does not spoil the others."""
    if len(volume) == 2:
        # Of two sources one may be occluded: lean on the better.
        return 0.35 * volume.max(0) + 0.65 * volume.min(0)
    return (volume.sum(0) - volume.max(0)) / (len(volume) - 1)


def _parabola(cost: np.ndarray, best: np.ndarray) -> np.ndarray:
    """[h,w] sub-plane offset in -0.5..0.5 from the neighbours of the lowest cost."""
    inner = np.clip(best, 1, len(cost) - 2)
    left, middle, right = (np.take_along_axis(cost, (inner + k)[None], 0)[0] for k in (-1, 0, 1))
    curvature = left - 2 * middle + right
    offset = np.where(curvature > 1e-3, 0.5 * (left - right) / np.maximum(curvature, 1e-3), 0.0)
    return np.where(best == inner, np.clip(offset, -0.5, 0.5), 0.0)


def _uniqueness(cost: np.ndarray, best: np.ndarray, lowest: np.ndarray) -> np.ndarray:
    """[h,w] in 0..1: how far the best plane beats the best plane that is not its neighbour."""
    apart = np.abs(np.arange(len(cost))[:, None, None] - best) > 2
    second = np.where(apart, cost, np.inf).min(0)
    return np.clip((second - lowest) / (0.25 * np.maximum(second, 1.0)), 0.0, 1.0)


def agreement(view: SweepDepth, K: np.ndarray, other: SweepDepth, K_other: np.ndarray,
              T_other_view: np.ndarray) -> np.ndarray:
    """[h,w] in 0..1: how well another view's depth agrees where this view's depth lands in it."""
    h, w = view.rho.shape
    K, K_other = K.astype(np.float32), K_other.astype(np.float32)
    v, u = np.mgrid[:h, :w].astype(np.float32)
    x, y = (u - K[0, 2]) / K[0, 0] / view.rho, (v - K[1, 2]) / K[1, 1] / view.rho
    R, t = T_other_view[:3, :3].astype(np.float32), T_other_view[:3, 3].astype(np.float32)
    z = 1.0 / view.rho
    X, Y, Z = (R[i, 0] * x + R[i, 1] * y + R[i, 2] * z + t[i] for i in range(3))
    Z = np.maximum(Z, 1e-6)
    at = cv2.remap(other.rho, K_other[0, 0] * X / Z + K_other[0, 2],
                   K_other[1, 1] * Y / Z + K_other[1, 2], cv2.INTER_NEAREST,
                   borderMode=cv2.BORDER_CONSTANT, borderValue=0.0)
    off = np.log(np.maximum(at, 1e-6) * Z)
    return np.where(at > 0, np.exp(-(off / 0.06) ** 2), 0.0).astype(np.float32)


def fill(rho: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """[h,w]: inverse depth with its badly known parts filled from around (push-pull)."""
    levels = [(rho * weight, weight)]
    while min(levels[-1][1].shape) > 2:
        levels.append(tuple(cv2.pyrDown(x) for x in levels[-1]))
    value, w = levels[-1]
    filled = value / np.maximum(w, 1e-6) if w.max() > 1e-6 else np.full_like(value, rho.mean())
    for value, w in reversed(levels[:-1]):
        coarse = cv2.pyrUp(filled, dstsize=(value.shape[1], value.shape[0]))
        blend = np.clip(w * 4.0, 0.0, 1.0)
        filled = blend * value / np.maximum(w, 1e-6) + (1.0 - blend) * coarse
    return filled
