"""The scale between two depths of the same surface, robustly."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class ScaleEstimate:
    """scale: the factor from the second depth to the first.

    spread: robust standard deviation of one log ratio; count: how many ratios there were.
    """

    scale: float
    spread: float
    count: int

    @property
    def sigma(self) -> float:
        """Standard deviation of the log-scale itself.

        Errors of neighbouring pixels are alike, so that only some of the ratios are independent.
        """
        return 1.25 * self.spread / max(1.0, self.count / 25.0) ** 0.5


def log_depth_ratio(depth_a: Tensor, depth_b: Tensor, weights: Tensor) -> ScaleEstimate:
    """Weighted median of log(depth_a / depth_b), each [N]; non-positive depths do not count.

    weights: [N] >= 0. With nothing to compare the scale is nan and the count 0.
    """
    usable = (depth_a > 0) & (depth_b > 0) & (weights > 0)
    usable &= torch.isfinite(depth_a) & torch.isfinite(depth_b)
    ratios = torch.log(depth_a[usable].double() / depth_b[usable].double())
    if ratios.numel() == 0:
        return ScaleEstimate(float('nan'), float('inf'), 0)
    weights = weights[usable].double()
    centre = weighted_median(ratios, weights)
    spread = 1.4826 * weighted_median((ratios - centre).abs(), weights)
    return ScaleEstimate(float(torch.exp(centre)), float(spread), ratios.numel())


def weighted_median(values: Tensor, weights: Tensor) -> Tensor:
    """The value [] at which half the weight lies on either side; values, weights [N]."""
    order = values.argsort()
    below = weights[order].cumsum(0)
    half = torch.searchsorted(below, 0.5 * below[-1:])
    return values[order][half.clamp_max(len(values) - 1)][0]
