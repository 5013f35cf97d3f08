"""The contract of a geometry model: VGGT's two calls, which anything else can fill."""

from __future__ import annotations

from typing import Protocol, Sequence

from ..types import Frame, FrameEncoding, WindowPrediction


class GeometryModel(Protocol):
    """Dense geometry of a window of views."""

    min_views: int   # 1 for VGGT, 2 for the classical model

    def encode(self, frame: Frame) -> FrameEncoding:
        """Compute once per frame what ``infer`` reuses; kept with the frame's keyframe."""

    def infer(self, encodings: Sequence[FrameEncoding]) -> WindowPrediction:
        """Depth, confidence, K and poses of a window: the current frame first, then keyframes.

        Every inference has its own arbitrary scale. Raises ValueError for fewer than
        ``min_views`` views or views of different sizes.
        """
