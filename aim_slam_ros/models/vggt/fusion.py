"""How the depth head merges a level of its pyramid with the coarser ones."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor, nn


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
        return x + self.conv2(self.conv1(x).relu())


class FeatureFusion(nn.Module):
    """One level and what comes from the coarser ones; the coarsest ``merges`` nothing."""

    def __init__(self, dim: int, merges: bool) -> None:
        super().__init__()
        if merges:
            self.resConfUnit1 = ResidualUnit(dim)
        self.resConfUnit2 = ResidualUnit(dim)
        self.out_conv = nn.Conv2d(dim, dim, 1)

    def forward(self, level: Tensor, coarser: Tensor | None, size: tuple[int, int]) -> Tensor:
        """level, coarser: [V,C,h,w]; returns [V,C,*size]."""
        x = level if coarser is None else coarser + self.resConfUnit1(level)
        return self.out_conv(resized(self.resConfUnit2(x), size))
