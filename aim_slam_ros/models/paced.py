"""A model that takes its time."""

from __future__ import annotations

import time
from typing import Sequence

from ..types import Frame, FrameEncoding, WindowPrediction
from .base import GeometryModel


class PacedModel:
    """Another model whose inferences last at least so long; it rests for what is left of it."""

    def __init__(self, model: GeometryModel, least_s: float) -> None:
        self._model = model
        self._least_s = least_s
        self.min_views = model.min_views

    def encode(self, frame: Frame) -> FrameEncoding:
        return self._model.encode(frame)

    def infer(self, encodings: Sequence[FrameEncoding]) -> WindowPrediction:
        until = time.monotonic() + self._least_s
        prediction = self._model.infer(encodings)
        time.sleep(max(0.0, until - time.monotonic()))
        return prediction
