"""Inferences over one image, averaged: a wider window adds to what the narrower one said.

The paper takes the wider window's answer alone. What a model says of an image in two windows has
errors that are partly independent, and the first inference has been paid for.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from ..geometry import sim3
from ..registration.scale import log_depth_ratio
from ..types import WindowPrediction
from .alignment import log_mean, together

_GRID = 8   # every eighth pixel, both ways, tells the units apart


def merged(wider: WindowPrediction, narrower: WindowPrediction) -> WindowPrediction:
    """The wider prediction in its own unit, its first views averaged with the narrower one's.

    The narrower window has the first views of the wider one, in the same order. Log depths and
    poses are weighted by confidence, and confidences above 1 add up. A window that only turned
    has no depth to average.
    """
    if wider.rotation_only or narrower.rotation_only:
        return wider
    n = len(narrower.depth)
    own, other = wider.confidence[:n] - 1.0, narrower.confidence - 1.0
    unit = log_depth_ratio(_grid(wider.depth[:n]), _grid(narrower.depth),
                           _grid((own * other).clamp_min(0.0).sqrt()))
    if not unit.count:
        return wider
    depth, confidence = wider.depth.clone(), wider.confidence.clone()
    depth[:n] = log_mean(wider.depth[:n], own, unit.scale * narrower.depth, other)
    confidence[:n] = 1.0 + together(own, other)
    return replace(wider, depth=depth, confidence=confidence,
                   T_first_cam=_poses(wider, narrower, unit.scale))


def _poses(wider: WindowPrediction, narrower: WindowPrediction, unit: float) -> Tensor:
    """T_first_cam [N,4,4]: the weighted mean where both have a say."""
    T = wider.T_first_cam.clone()
    for view in range(1, len(narrower.depth)):
        both = torch.stack([wider.T_first_cam[view], narrower.T_first_cam[view]])
        both[1, :3, 3] *= unit
        weights = torch.stack([_grid(p.confidence[view]).double().mean().cpu() - 1.0
                               for p in (wider, narrower)])
        if float(weights.sum()) > 0.0:
            T[view] = sim3.mean(both, weights)
    return T


def _grid(images: Tensor) -> Tensor:
    return images[..., ::_GRID, ::_GRID].reshape(-1)
