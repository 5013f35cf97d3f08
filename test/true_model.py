"""A geometry model that knows a clip."""

from __future__ import annotations

import math
from typing import Sequence

import clip as clips
import numpy as np
import torch
from clip import Clip

from aim_slam_ros.types import Frame, FrameEncoding, WindowPrediction


class TrueModel:
    """The clip's true geometry, in a unit of its own for every inference.

    widest: views of the largest window so far. An encoding's features are the image's index.
    """

    min_views = 1

    def __init__(self, clip: Clip) -> None:
        self._clip = clip
        self._index = {clip.frame(i).image.tobytes(): i for i in range(len(clip))}
        self._rng = np.random.default_rng(0)
        self.widest = 0

    def encode(self, frame: Frame) -> FrameEncoding:
        return FrameEncoding(frame, clips.tiny_descriptor(frame.image),
                             self._index[frame.image.tobytes()])

    def infer(self, encodings: Sequence[FrameEncoding]) -> WindowPrediction:
        self.widest = max(self.widest, len(encodings))
        at = [encoding.features for encoding in encodings]
        unit = math.exp(0.3 * self._rng.standard_normal())
        depth = torch.stack([self._clip.depth_of(i) for i in at]) / unit
        T = torch.stack([self._clip.T_a_b(at[0], i) for i in at])
        T[:, :3, 3] /= unit
        K = encodings[0].frame.K
        assert K is not None
        return WindowPrediction(depth, torch.full(depth.shape, 5.0), K.expand(len(at), 3, 3), T)
