"""How the depth head merges a level of its pyramid with the coarser ones."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor, nn

from .products import PixelLinear


def resized(x: Tensor, size: tuple[int, int]) -> Tensor:
    """[V,C,h,w] to [V,C,*size], bilinear with the corners on the corners."""
    return F.interpolate(x, size, mode='bilinear', align_corners=True)


class ResidualUnit(nn.Module):
    """Two convolutions. What they are added to is not x but relu(x): the network was trained with
    a first ReLU that overwrites its input.
    """

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(dim, dim, 3, padding=1)
        self.conv2 = nn.Conv2d(dim, dim, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        x = x.relu()
        return self.conv2(self.conv1(x).relu_()).add_(x)


class FeatureFusion(nn.Module):
    """One level and what comes from the coarser ones; the coarsest ``merges`` nothing."""

    def __init__(self, dim: int, merges: bool) -> None:
        super().__init__()
        if merges:
            self.resConfUnit1 = ResidualUnit(dim)
        self.resConfUnit2 = ResidualUnit(dim)
        self.out_conv = PixelLinear(dim, dim)

    def forward(self, level: Tensor, coarser: Tensor | None, size: tuple[int, int]) -> Tensor:
        """level, coarser: [V,C,h,w]; returns [V,C,*size].

        The last layer comes before the resizing, with a quarter of the pixels: weights of an
        interpolation add up to 1, so it is the same.
        """
        x = level if coarser is None else self.resConfUnit1(level).add_(coarser)
        return resized(self.out_conv(self.resConfUnit2(x)), size)
