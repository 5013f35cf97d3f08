"""The patch embedding: a DINOv2 vision transformer with register tokens."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .layers import Block, LayerNorm
from .sizes import PATCH_PX, VggtSizes

_EPS = 1e-6
_KEPT_SIZES = 4   # image sizes whose position embeddings are remembered


class PatchProjection(nn.Module):
    """Every patch of 14x14 pixels becomes a token."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.proj = nn.Conv2d(3, dim, PATCH_PX, stride=PATCH_PX)

    def forward(self, images: Tensor) -> Tensor:
        """[N,3,H,W] to [N,H/14*W/14,C]."""
        return self.proj(images.to(self.proj.weight.dtype)).flatten(2).transpose(1, 2)


class VisionTransformer(nn.Module):
    """Images to patch tokens, each image on its own."""

    def __init__(self, sizes: VggtSizes) -> None:
        super().__init__()
        dim, self._side = sizes.dim, sizes.image_size // PATCH_PX
        self.cls_token = nn.Parameter(torch.empty(1, 1, dim))
        self.pos_embed = nn.Parameter(torch.empty(1, 1 + self._side ** 2, dim))
        self.register_tokens = nn.Parameter(torch.empty(1, sizes.registers, dim))
        # Takes the place of patches hidden in training; in the checkpoint, not used here.
        self.mask_token = nn.Parameter(torch.empty(1, dim))
        self.patch_embed = PatchProjection(dim)
        self.blocks = nn.ModuleList(
            Block(dim, sizes.vit_heads, eps=_EPS) for _ in range(sizes.vit_depth))
        self.norm = LayerNorm(dim, eps=_EPS)
        self._positions: dict[tuple[int, int], Tensor] = {}

    def forward(self, images: Tensor) -> Tensor:
        """[N,3,H,W], normalised, to [N,H/14*W/14,C] float32."""
        n, _, height, width = images.shape
        position = self._position(height // PATCH_PX, width // PATCH_PX)
        patches = self.patch_embed(images) + position
        cls = self.cls_token + self.pos_embed[:, :1]
        x = torch.cat([torch.cat([cls, self.register_tokens], 1).expand(n, -1, -1), patches], 1)
        for block in self.blocks:
            x = block(x)
        return self.norm(x[:, -patches.shape[1]:])

    def _position(self, rows: int, columns: int) -> Tensor:
        """[1,rows*columns,C]: the learned square grid, resampled to this one."""
        if (rows, columns) not in self._positions:
            if len(self._positions) >= _KEPT_SIZES:
                self._positions.clear()
            self._positions[rows, columns] = self._resampled(rows, columns)
        return self._positions[rows, columns]

    def _resampled(self, rows: int, columns: int) -> Tensor:
        learned = self.pos_embed[:, 1:]
        if (rows, columns) == (self._side, self._side):
            return learned
        grid = learned.transpose(1, 2).unflatten(2, (self._side, self._side))
        grid = F.interpolate(grid, (rows, columns), mode='bicubic', antialias=True)
        return grid.flatten(2).transpose(1, 2)
