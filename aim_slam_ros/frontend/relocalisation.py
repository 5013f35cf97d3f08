"""A lost image found again among retrieved keyframes."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from ..config import Config
from ..geometry import sim3
from ..types import FrameEncoding, Keyframe
from .following import Followed, Follower
from .keyframe_map import KeyframeMap
from .stages import Stopwatch
from .window import WindowTracker


class Relocalisation:
    """Tries the most similar keyframes: first by following from their pose, then by the model."""

    def __init__(self, config: Config, keyframes: KeyframeMap, follower: Follower,
                 window: WindowTracker) -> None:
        self._config = config
        self._map = keyframes
        self._follower = follower
        self._window = window

    def find(self, encoding: FrameEncoding, K: Tensor,
             clock: Stopwatch) -> Followed | None:
        """The image followed against the keyframe that it was found at, or None."""
        grey = encoding.frame.grey
        similar = self._map.similar(encoding.descriptor, self._config.relocalisation.candidates)
        for keyframe in similar:
            found = self._at(keyframe, sim3.rigid_part(keyframe.T_world_kf), grey, K, clock)
            if found is not None:
                return found
        for keyframe in similar[:1]:
            window = [keyframe, *self._map.overlapping(keyframe.keyframe_id)[:1]]
            estimate = self._window.estimate(encoding, None, window, clock)
            if estimate.ok:
                guess = sim3.rigid_part(estimate.result.T_world_frame)
                return self._at(keyframe, guess, grey, K, clock)
        return None

    def _at(self, keyframe: Keyframe, guess: Tensor, grey: np.ndarray, K: Tensor,
            clock: Stopwatch) -> Followed | None:
        with clock.stage('follow'):
            found = self._follower.follow(grey, K, guess, [keyframe])
        enough = self._config.relocalisation.min_matched_fraction
        return found if found.ok and found.matched_fraction >= enough else None
