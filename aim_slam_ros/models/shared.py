"""One model for several users in one process."""

from __future__ import annotations

import threading
from typing import Sequence

from ..types import Frame, FrameEncoding, WindowPrediction
from .base import GeometryModel


class SharedModel:
    """A GeometryModel that one thread at a time may ask: weights and caches exist once."""

    def __init__(self, model: GeometryModel) -> None:
        self._model = model
        self._lock = threading.Lock()
        self.min_views = model.min_views

    def encode(self, frame: Frame) -> FrameEncoding:
        with self._lock:
            return self._model.encode(frame)

    def infer(self, encodings: Sequence[FrameEncoding]) -> WindowPrediction:
        with self._lock:
            return self._model.infer(encodings)
