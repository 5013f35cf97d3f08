"""The scale between two depths of the same surface, robustly."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
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
    a, b, w = (x.cpu().numpy().astype(np.float64) for x in (depth_a, depth_b, weights))
    usable = (a > 0) & (b > 0) & (w > 0) & np.isfinite(a) & np.isfinite(b)
    ratios, w = np.log(a[usable] / b[usable]), w[usable]
    if not len(ratios):
        return ScaleEstimate(float('nan'), float('inf'), 0)
    centre = weighted_median(ratios, w)
    spread = 1.4826 * weighted_median(np.abs(ratios - centre), w)
    return ScaleEstimate(math.exp(centre), spread, len(ratios))


def weighted_median(values: np.ndarray, weights: np.ndarray) -> float:
    """The value at which half the weight lies on either side; values, weights [N]."""
    order = values.argsort()
    below = weights[order].cumsum()
    half = np.searchsorted(below, 0.5 * below[-1])
    return float(values[order[min(half, len(values) - 1)]])
