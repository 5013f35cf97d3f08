"""Geometry models behind one contract (base.py), chosen by name."""

from __future__ import annotations

from ..config import Config
from .base import GeometryModel


def make_model(config: Config) -> GeometryModel:
    """The model named by ``model.name``; its imports happen only when it is chosen."""
    from .classical.model import ClassicalModel
    return ClassicalModel(config.classical, config.camera.fov_deg, config.seed)
