"""Which sigmas make kappa honest: 1 in the median of the windows that are never widened."""

from __future__ import annotations

import math
import statistics
from typing import Mapping, Sequence

from aim_slam_ros.config import Config
from aim_slam_ros.types import FrameResult

_SIGMAS = {
    'image': ('tracking.sigma_model_px',),
    'paper': ('joint_tracking.sigma_ray', 'joint_tracking.sigma_pixel',
              'joint_tracking.sigma_log_distance')}


def starting_views(config: Config) -> int:
    """How many views a window has at first, the current image included."""
    return min(config.sigma.min_window, config.sigma.max_window)


def unwidened(config: Config) -> Config:
    """The configuration with windows that stay as large as they start."""
    return config.with_values({'sigma.max_window': f'{starting_views(config)}'})


def kappas_of(results: Sequence[FrameResult], config: Config) -> list[float]:
    """Of the windows that were as large as a window starts, the current image included."""
    return [r.kappa for r in results
            if r.kappa is not None and len(r.window) + 1 == starting_views(config)]


def honest_sigmas(config: Config, kappas: Sequence[float]) -> Mapping[str, str]:
    """The tracker's sigmas that would have given these kappas (some, positive) a median of 1."""
    factor = math.sqrt(statistics.median(kappas))
    return {name: f'{factor * _value(config, name):.3g}'
            for name in _SIGMAS[config.tracking.tracker]}


def _value(config: Config, name: str) -> float:
    section, _, field = name.partition('.')
    return float(getattr(getattr(config, section), field))
