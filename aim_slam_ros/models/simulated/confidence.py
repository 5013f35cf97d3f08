"""A confidence that knows something of the error, but not much."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import ndtri

# Two normal variables with this correlation have ranks that correlate at .5 (Spearman).
_CORRELATION = 2.0 * math.sin(0.5 * math.pi / 6.0)
_SEEN = (1.5, 0.7)          # mean and deviation of log(confidence - 1): about 5, between 2 and 20
_FILLED = (-4.0, 0.3)       # 1.02: the map takes less than 1.05 for filled in
_SAMPLE = 13                # every so many pixels stand for all when ranks are looked up


def confidence(error: np.ndarray, known: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """1 + exp(x), [H,W] float32. error: [H,W], absolute; noise: [H,W], normal."""
    ranked = np.sort(error[known][::_SAMPLE])
    normal = ndtri((np.arange(len(ranked)) + 0.5) / len(ranked))
    score = np.interp(error, ranked, normal).astype(np.float32)
    seen = _SEEN[0] + _SEEN[1] * (math.sqrt(1.0 - _CORRELATION ** 2) * noise
                                  - _CORRELATION * score)
    return 1.0 + np.exp(np.where(known, seen, _FILLED[0] + _FILLED[1] * noise))
