"""Geometry models behind one contract (base.py), chosen by name."""

from __future__ import annotations

from ..config import Config
from .base import GeometryModel
from .paced import PacedModel
from .truth import TruthProvider


def make_model(config: Config, truth: TruthProvider | None = None) -> GeometryModel:
    """The model named by ``model.name``, at most as fast as ``model.min_inference_s`` allows.

    Its imports happen only when it is chosen. truth: where there is one; only the simulated model
    asks it. Raises ConfigError where the settings or the weights cannot be used.
    """
    model = _named(config, truth)
    least_s = config.model.min_inference_s
    return PacedModel(model, least_s) if least_s > 0.0 else model


def _named(config: Config, truth: TruthProvider | None) -> GeometryModel:
    if config.model.name == 'vggt':
        from .vggt.making import make_vggt
        return make_vggt(config)
    if config.model.name == 'simulated':
        from .simulated.making import make_simulated
        return make_simulated(config, truth)
    from .classical.model import ClassicalModel
    return ClassicalModel(config.classical, config.camera.fov_deg, config.seed)
