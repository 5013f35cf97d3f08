"""Registration of one keyframe's stored points in another keyframe's image."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from ..geometry import camera, sim3
from ..registration.flow import LEVELS, TIGHT_LEVELS, refine
from ..registration.rigid import solve_rigid
from ..registration.scale import ScaleEstimate, log_depth_ratio
from ..types import KeyframeEvent

_STEP = 8               # px between sampled points
_PATCH = 15             # px, window of texture and similarity
_MIN_TEXTURE = 4.0      # grey levels of standard deviation; flatter patches match anything
_MIN_SIMILARITY = 0.6   # normalised cross-correlation of a patch that shows the same
_MIN_POINTS = 40
_DEPTH_ERROR = 0.05     # relative, of stored points, along their rays
_ROUNDS = ((30.0, LEVELS), (10.0, TIGHT_LEVELS))    # reach [px] and pyramid levels of a match


@dataclass(frozen=True)
class View:
    """A keyframe as registration needs it.

    grey: [H,W] uint8. texture: [H,W] float32, local standard deviation. points: [H,W,3] float32.
    samples: [N,2] int, (u, v) of confident and textured pixels on a grid.
    median_depth: of the samples, in the keyframe's unit; nan without samples.
    """

    grey: np.ndarray
    texture: np.ndarray
    points: Tensor
    confidence: Tensor
    K: Tensor
    samples: np.ndarray
    median_depth: float

    @classmethod
    def of(cls, event: KeyframeEvent) -> View:
        grey = cv2.cvtColor(event.image, cv2.COLOR_RGB2GRAY)
        texture = _deviation(grey.astype(np.float32))
        samples = _samples(event, texture)
        z = event.points_cam[..., 2][samples[:, 1], samples[:, 0]]
        return cls(grey, texture, event.points_cam.float(), event.confidence, event.K, samples,
                   float(z.median()) if len(samples) else float('nan'))


@dataclass(frozen=True)
class OneWay:
    """Where the target camera is, as the reference keyframe's points see it.

    T_target_ref: rigid [4,4], in the reference keyframe's unit. scale: the factor from the
    target keyframe's unit to the reference's. matched_fraction: share of the reference's samples
    whose surroundings look the same in the target's image, warped by the solution; more than the
    flow's matches, which select themselves. kappa: reduced chi-square of the solution.
    sigma: [6] (translation, rotation) of T_target_ref's left perturbation.
    """

    T_target_ref: Tensor
    scale: ScaleEstimate
    matched_fraction: float
    kappa: float
    sigma: np.ndarray


def register(reference: View, target: View, T_target_ref_guess: Tensor) -> OneWay | None:
    """Match and solve, twice; None where too little is found to solve anything.

    The target's image is warped into the reference view by the predicted geometry, so that
    optical flow compares patches of the same shape even from another distance or angle.
    """
    T = sim3.rigid_part(T_target_ref_guess)
    uv_ref = reference.samples
    points = reference.points[uv_ref[:, 1], uv_ref[:, 0]].double().numpy()
    for reach_px, levels in _ROUNDS:
        if len(points) < _MIN_POINTS:
            return None
        uv_target, valid = _match(reference, target, T, reach_px, levels)
        if valid.sum() < _MIN_POINTS:
            return None
        solution = solve_rigid(points[valid], uv_target[valid], target.K, T,
                               spread_ref=_DEPTH_ERROR * points[valid])
        T = solution.T_cam_ref
    good = np.flatnonzero(valid)[solution.inliers]
    alike = _similarity(reference, target, T)[uv_ref[:, 1], uv_ref[:, 0]] > _MIN_SIMILARITY
    good = good[alike[good]]
    if len(good) < _MIN_POINTS:
        return None
    covariance = np.linalg.inv(solution.information + 1e-9 * np.eye(6))
    # Errors of neighbouring points are alike: only about one in 25 counts (as in ScaleEstimate).
    sigma = np.sqrt(25.0 * max(solution.kappa, 1.0) * np.diag(covariance))
    return OneWay(T, _scale(target, T, points[good], uv_target[good]), float(alike.mean()),
                  solution.kappa, sigma)


def _samples(event: KeyframeEvent, texture: np.ndarray) -> np.ndarray:
    """[N,2] int: grid pixels that are textured and among the better known of the keyframe."""
    z = event.points_cam[..., 2]
    usable = event.points_cam.isfinite().all(-1) & (z > 0) & event.confidence.isfinite()
    if not bool(usable.any()):
        return np.zeros((0, 2), int)
    usable &= event.confidence >= event.confidence[usable].median()
    chosen = usable.numpy() & (texture > _MIN_TEXTURE)
    v, u = np.nonzero(chosen[_STEP // 2::_STEP, _STEP // 2::_STEP])
    return np.stack([u, v], 1) * _STEP + _STEP // 2


def _predict(reference: View, K: Tensor, T_target_ref: Tensor) -> np.ndarray:
    """[H,W,2] float32: where every pixel of the reference is expected in the target, or -1."""
    uv = camera.project(sim3.transform(T_target_ref, reference.points), K)
    return uv.nan_to_num(-1.0, -1.0, -1.0).clamp(-1e4, 1e4).numpy()


def _match(reference: View, target: View, T_target_ref: Tensor, reach_px: float,
           levels: int) -> tuple[np.ndarray, np.ndarray]:
    """The reference's samples in the target: uv [N,2] float32 and valid [N] bool."""
    predicted = _predict(reference, target.K, T_target_ref)
    warped = _look_up(target.grey, predicted)
    uv_ref = reference.samples.astype(np.float32)
    flow = refine(reference.grey, warped, uv_ref, uv_ref, reach_px, levels=levels)
    # The flow ends in the warped image; the prediction there says where that is in the target.
    uv = _look_up(predicted, flow.uv_b[:, None])[:, 0]
    height, width = target.grey.shape
    return uv, flow.valid & ((uv >= 0) & (uv <= (width - 1, height - 1))).all(1)


def _similarity(reference: View, target: View, T_target_ref: Tensor) -> np.ndarray:
    """[H,W] float32 in -1..1: normalised cross-correlation with the warped target."""
    predicted = _predict(reference, target.K, T_target_ref)
    warped = _look_up(target.grey, predicted).astype(np.float32)
    a = reference.grey.astype(np.float32)
    size = (_PATCH, _PATCH)
    covariance = cv2.blur(a * warped, size) - cv2.blur(a, size) * cv2.blur(warped, size)
    correlation: np.ndarray = covariance / np.maximum(
        reference.texture * _deviation(warped), 1.0)
    return correlation


def _look_up(image: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """The image at pixels uv [h,w,2] float32, bilinearly; 0 outside."""
    u, v = np.ascontiguousarray(uv[..., 0]), np.ascontiguousarray(uv[..., 1])
    return cv2.remap(image, u, v, cv2.INTER_LINEAR)


def _deviation(grey: np.ndarray) -> np.ndarray:
    """[H,W] float32: local standard deviation."""
    size = (_PATCH, _PATCH)
    variance = cv2.blur(grey * grey, size) - cv2.blur(grey, size) ** 2
    deviation: np.ndarray = np.sqrt(np.maximum(variance, 0.0))
    return deviation


def _scale(target: View, T_target_ref: Tensor, points: np.ndarray,
           uv: np.ndarray) -> ScaleEstimate:
    """How the reference's points and the target's stored points at the same pixels compare."""
    depth_ref = sim3.transform(T_target_ref, torch.from_numpy(points))[:, 2]
    column, row = torch.from_numpy(np.rint(uv).astype(np.int64)).unbind(1)
    known = target.points[row, column, 2]
    weights = (target.confidence[row, column] - 1.0).clamp_min(0.0)
    return log_depth_ratio(depth_ref, known, weights)
