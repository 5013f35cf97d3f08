"""The errors of an inference: of its frames and the seed alone, whoever asks and however often.

Every draw has a generator of its own, keyed by what it belongs to: an inference is its first
frame and the set of the others.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from typing import Sequence

import numpy as np
import torch
from torch import Tensor

from ...geometry import sim3
from ...types import Frame
from .levels import ErrorLevels

_WAVES = 4      # half waves of the warp along each side of the image, the constant among them


@dataclass(frozen=True)
class ViewErrors:
    """One view of one inference.

    focal: factor. rotation: [3] axis-angle in the view's own axes; translation: [3] in the first
    view's axes, in median depths. log_depth: [H,W] float32, warp and pixel noise.
    noise: [H,W] float32, normal; what of the confidence has nothing to do with the error.
    """

    focal: float
    rotation: np.ndarray
    translation: np.ndarray
    log_depth: np.ndarray
    noise: np.ndarray

    def moved(self, T_first_cam: Tensor, median_depth: float) -> Tensor:
        """The view's true pose with its error; both rigid, in metres."""
        xi = torch.zeros(7, dtype=torch.float64)
        xi[3:6] = torch.from_numpy(self.rotation)
        T = T_first_cam @ sim3.exp(xi)
        T[:3, 3] += torch.from_numpy(self.translation) * median_depth
        return T


class InferenceErrors:
    """All that is wrong with one inference. frames: the first, then the others in any order."""

    def __init__(self, levels: ErrorLevels, seed: int, frames: Sequence[Frame]) -> None:
        self._levels = levels
        self._seed = seed
        self._window = (frames[0].stamp_ns, *sorted(frame.stamp_ns for frame in frames[1:]))

    def scale(self) -> float:
        """The length of a metre in the inference's unit."""
        draw = self._generator('scale', *self._window).standard_normal()
        return math.exp(self._levels.log_scale * draw)

    def of(self, frame: Frame) -> ViewErrors:
        """The errors of one of the frames."""
        levels, size = self._levels, (frame.height, frame.width)
        draws = self._generator('view', frame.stamp_ns, *self._window)
        focal = 1.0 + levels.focal * self._generator('focal', frame.stamp_ns).standard_normal()
        rotation, translation = draws.standard_normal((2, 3)) / math.sqrt(3.0)
        waves = draws.standard_normal((_WAVES, _WAVES))
        if levels.lasting_warp:
            waves = self._generator('warp', frame.stamp_ns).standard_normal((_WAVES, _WAVES))
        log_depth = levels.warp * _smooth(waves, size) \
            + np.float32(levels.pixel) * draws.standard_normal(size, np.float32)
        return ViewErrors(focal, levels.rotation_rad * rotation, levels.translation * translation,
                          log_depth, draws.standard_normal(size, np.float32))

    def _generator(self, purpose: str, *stamps_ns: int) -> np.random.Generator:
        key = repr((purpose, self._seed, stamps_ns)).encode()
        return np.random.default_rng(int.from_bytes(hashlib.blake2b(key).digest(), 'little'))


def _smooth(waves: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """[H,W] float32 of the slowest cosines; of mean square 1 for normal waves [_WAVES,_WAVES]."""
    along_v, along_u = (_cosines(length) for length in size)
    return (along_v.T @ waves @ along_u / _WAVES).astype(np.float32)


def _cosines(length: int) -> np.ndarray:
    """[_WAVES,length]: the first rows of the orthonormal cosine transform, of mean square 1."""
    k = np.arange(_WAVES)[:, None]
    rows = np.cos(np.pi * k * (np.arange(length) + 0.5) / length)
    return np.where(k > 0, math.sqrt(2.0), 1.0) * rows
