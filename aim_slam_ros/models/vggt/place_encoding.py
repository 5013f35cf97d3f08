"""Where a pixel of a feature map is in the image, told to the depth head in sines and cosines."""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from torch import Tensor

_BASE = 100.0
_WEIGHT = 0.1     # beside the features


@lru_cache(maxsize=16)
def place_encoding(dim: int, height: int, width: int, aspect: float, device: str) -> Tensor:
    """[1,dim,height,width] float32, channels-last; shared: do not write into it.

    aspect: W/H of the image. Places are those of pixel centres in an image whose half diagonal
    is 1. The first half of the channels encodes x, the second y. In float64 inside, which is why
    it is kept.
    """
    half_diagonal = math.hypot(aspect, 1.0)
    x = _centres(width, aspect / half_diagonal, device)
    y = _centres(height, 1.0 / half_diagonal, device)
    waves_x = _waves(x, dim // 2)[None].expand(height, -1, -1)
    waves_y = _waves(y, dim // 2)[:, None].expand(-1, width, -1)
    encoding = _WEIGHT * torch.cat([waves_x, waves_y], -1).float()
    return encoding.permute(2, 0, 1)[None]


def _centres(count: int, half: float, device: str) -> Tensor:
    """[count]: middles of equal parts of the interval from -half to half."""
    end = half * (count - 1) / count
    return torch.linspace(-end, end, count, dtype=torch.float32, device=device)


def _waves(x: Tensor, dim: int) -> Tensor:
    """[n] to [n,dim]: sines, then cosines, of dim/2 frequencies."""
    k = torch.arange(dim // 2, dtype=torch.float64, device=x.device)
    angle = x.double()[:, None] * _BASE ** (-k / (dim // 2))
    return torch.cat([angle.sin(), angle.cos()], -1)
