"""The model that the settings ask for."""

from __future__ import annotations

from ...config import Config, ConfigError
from ..truth import TruthProvider
from .levels import PRESETS
from .model import SimulatedModel


def make_simulated(config: Config, truth: TruthProvider | None) -> SimulatedModel:
    """Raises ConfigError where nobody knows the truth."""
    if truth is None:
        raise ConfigError('model.name: simulated answers from the depth and poses of a recording, '
                          'which only evaluate has; choose classical or vggt')
    return SimulatedModel(truth, PRESETS[config.simulated.preset], config.seed)
