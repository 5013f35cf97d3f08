"""Which keyframes an image is followed against, and which of them counts as its reference."""

from __future__ import annotations

import math

import numpy as np
from torch import Tensor

from ..config import Config
from ..types import Keyframe
from .following import Followed, Follower
from .keyframe_map import KeyframeMap


class References:
    """The reference keyframe and its neighbours by viewpoint."""

    def __init__(self, config: Config, keyframes: KeyframeMap, follower: Follower) -> None:
        self._config = config
        self._map = keyframes
        self._follower = follower
        self.main_id = -1

    @property
    def main(self) -> Keyframe:
        return self._map[self.main_id]

    def near(self, T_world_cam: Tensor) -> list[Keyframe]:
        """The reference first, then the covisible keyframes with the nearest viewpoints."""
        others = sorted(self._map.overlapping(self.main_id),
                        key=lambda keyframe: _distance(keyframe, T_world_cam))
        return [self.main, *others[:self._config.following.references - 1]]

    def reuse(self, grey: np.ndarray, K: Tensor, followed: Followed) -> Followed:
        """Take an older keyframe that sees the same as reference, where there is one.

        First among those already followed, then among the covisible ones with the nearest
        viewpoints. Returns the image followed against the new reference, or as it was.
        """
        for keyframe_id, fraction in sorted(followed.fractions.items(), key=lambda f: -f[1]):
            if fraction >= self._config.keyframes.reuse_above:
                return self._switch(grey, K, followed, keyframe_id)
        untried = [k for k in self._map.overlapping(self.main_id)
                   if k.keyframe_id not in followed.fractions]
        untried.sort(key=lambda keyframe: _distance(keyframe, followed.T_world_cam))
        for keyframe in untried[:2]:
            found = self._follower.follow(grey, K, followed.T_world_cam, [keyframe])
            if found.ok and found.matched_fraction >= self._config.keyframes.reuse_above:
                return self._switch(grey, K, followed, keyframe.keyframe_id)
        return followed

    def _switch(self, grey: np.ndarray, K: Tensor, followed: Followed,
                keyframe_id: int) -> Followed:
        before, self.main_id = self.main_id, keyframe_id
        again = self._follower.follow(grey, K, followed.T_world_cam,
                                      self.near(followed.T_world_cam))
        if again.ok and again.matched_fraction >= self._config.keyframes.promote_below:
            return again
        self.main_id = before
        return followed


def _distance(keyframe: Keyframe, T_world_cam: Tensor) -> float:
    """How far two viewpoints are apart: baseline by depth, plus angle in radians."""
    a, b = keyframe.T_world_kf.numpy(), T_world_cam.numpy()
    scale = float(np.linalg.norm(a[0, :3]))
    baseline = float(np.linalg.norm(a[:3, 3] - b[:3, 3]))
    cosine = (float((a[:3, :3] * b[:3, :3]).sum()) / scale - 1.0) / 2.0
    return baseline / max(keyframe.median_depth * scale, 1e-9) \
        + math.acos(max(-1.0, min(1.0, cosine)))
