"""An inference brought to the units of the map: every inference has a scale of its own."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from ..config import KeyframesConfig
from ..geometry import camera, sim3
from ..registration.scale import ScaleEstimate, log_depth_ratio
from ..types import GUESSED_CONFIDENCE, Keyframe, WindowPrediction
from .tracking import TrackingWindow

_GRID = 16  # every so many pixels, both ways: medians need no more


def unit_of(keyframe: Keyframe, prediction: WindowPrediction, view: int) -> ScaleEstimate:
    """The factor from the prediction's unit to the keyframe's, from their depths."""
    stored = keyframe.points_cam[::_GRID, ::_GRID, 2].reshape(-1)
    weight = ((keyframe.confidence[::_GRID, ::_GRID] - 1.0)
              * (prediction.confidence[view, ::_GRID, ::_GRID] - 1.0)).clamp_min(0.0).sqrt()
    return log_depth_ratio(stored, prediction.depth[view, ::_GRID, ::_GRID].reshape(-1),
                           weight.reshape(-1))


def pose_mean(window: TrackingWindow, min_seen: float) -> Tensor | None:
    """The mean over the keyframes of where the model puts the frame: Sim(3) [4,4], or None.

    Views of which the model saw a smaller share than min_seen have no say; the others count by
    that share and their confidence.
    """
    prediction, guesses, weights = window.prediction, [], []
    for view, keyframe in enumerate(window.keyframes, 1):
        seen = prediction.seen_share(view)
        unit = unit_of(keyframe, prediction, view)
        if seen < min_seen or not unit.count:
            continue
        T_kf_first = sim3.with_scale(sim3.identity(), unit.scale) \
            @ sim3.inverse(prediction.T_first_cam[view])
        guesses.append(keyframe.T_world_kf @ T_kf_first)
        weights.append(seen * float(prediction.confidence[view, ::_GRID, ::_GRID].mean() - 1.0))
    if not guesses:
        return None
    return sim3.mean(torch.stack(guesses), torch.tensor(weights, dtype=torch.float64))


def observed(keyframe: Keyframe, prediction: WindowPrediction, view: int,
             config: KeyframesConfig) -> Keyframe:
    """The keyframe with the prediction fused in, where that is wanted and the two fit together."""
    if not config.fuse or prediction.seen_share(view) < config.min_confident:
        return keyframe
    unit = unit_of(keyframe, prediction, view)
    if not unit.count or unit.spread > config.max_fuse_spread:
        return keyframe
    return fused(keyframe, prediction, view, unit.scale, config.shared_focal)


def fused(keyframe: Keyframe, prediction: WindowPrediction, view: int, scale: float,
          shared_focal: bool = False) -> Keyframe:
    """The keyframe with one more observation: confidence-weighted averages (paper, III-D).

    Points are averaged in log depth along the keyframe's own rays, which keeps them on the rays
    they were seen on. The focal length is the prediction's where that is the camera's, as known by
    now; otherwise it is averaged recursively.
    """
    own, weight = keyframe.confidence - 1.0, prediction.confidence[view] - 1.0
    depth = log_mean(keyframe.points_cam[..., 2], own, scale * prediction.depth[view], weight)
    n = keyframe.observations
    K = keyframe.K.clone()
    K[:2, :2] = prediction.K[view][:2, :2]
    if not shared_focal:
        K[:2, :2] = (n * keyframe.K[:2, :2] + K[:2, :2]) / (n + 1)
    return replace(keyframe, points_cam=camera.unproject(depth, K), K=K,
                   confidence=1.0 + together(own, weight), observations=n + 1)


def log_mean(depth: Tensor, weight: Tensor, other: Tensor, other_weight: Tensor) -> Tensor:
    """The weighted mean of log depths, as a depth; all of one shape, in one unit."""
    share = other_weight / (weight + other_weight).clamp_min(1e-6)
    return depth * torch.exp(share * torch.log(other / depth))


def together(own: Tensor, other: Tensor) -> Tensor:
    """Confidences above 1 of two observations add up; two guesses are no observation."""
    better = torch.maximum(own, other)
    return torch.where(better < GUESSED_CONFIDENCE - 1.0, better, own + other)
