"""Rotary position embedding in two dimensions.

Half of a head's channels turn with the row of the patch, half with its column. Channel k of a half
and its partner, half of a half further, are the two coordinates of a plane that turns by
position * base^(-2k/D), where D is the size of the half. Patches count from 1; tokens that belong
to no place in the image are at 0 and do not turn.
"""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

_BASE = 100.0


def rotated(x: Tensor, turns: Tensor) -> Tensor:
    """x: [...,D] turned by turns: [2,...,D]."""
    a, b, c, d = x.chunk(4, -1)
    partner = torch.cat([b, a, d, c], -1)
    return torch.addcmul(x * turns[0], partner, turns[1])


@lru_cache(maxsize=16)
def view_turns(rows: int, columns: int, specials: int, dim: int, device: str) -> Tensor:
    """[2,T,dim] float32 for one view, its special tokens first: cosines, and sines with the sign
    that the partner of a channel has. Shared: do not write into it.
    """
    v, u = torch.meshgrid(torch.arange(rows, device=device) + 1,
                          torch.arange(columns, device=device) + 1, indexing='ij')
    places = torch.stack([v.flatten(), u.flatten()], -1).float()            # [rows*columns,2]
    places = torch.cat([places.new_zeros(specials, 2), places])
    exponent = torch.arange(0, dim // 2, 2, device=device, dtype=torch.float32) / (dim // 2)
    angle = places[..., None] * _BASE ** -exponent                          # [T,2,dim/4]
    cosine = torch.stack([angle.cos(), angle.cos()], -2)                    # [T,2,2,dim/4]
    sine = torch.stack([-angle.sin(), angle.sin()], -2)
    return torch.stack([cosine.flatten(1), sine.flatten(1)])


@lru_cache(maxsize=16)
def window_turns(views: int, rows: int, columns: int, specials: int, dim: int,
                 device: str) -> Tensor:
    """[2,views*T,dim]: the same for every view of a window, one after the other."""
    return view_turns(rows, columns, specials, dim, device).repeat(1, views, 1)
