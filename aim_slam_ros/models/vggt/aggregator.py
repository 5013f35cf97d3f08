"""Alternating attention: within each view, then over all views of the window."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Sequence, cast

import torch
from torch import Tensor, nn

from .layers import Block
from .rope import view_turns, window_turns
from .sizes import VggtSizes
from .vit import VisionTransformer


@dataclass(frozen=True)
class Grid:
    """An image in patches."""

    rows: int
    columns: int


@dataclass(frozen=True)
class Aggregated:
    """The tokens that the heads read, 2C wide: a frame block's and a global block's output.

    camera: [N,2C], every view's camera token of the last layer. layers: for each layer asked for
    [V,T,2C], the tokens (camera token and registers first) of the views asked for.
    """

    camera: Tensor
    layers: dict[int, Tensor]


class Aggregator(nn.Module):
    """Pairs of a frame block and a global block over the tokens of a window."""

    def __init__(self, sizes: VggtSizes) -> None:
        super().__init__()
        dim = sizes.dim
        self._specials, self._head_dim = sizes.specials, dim // sizes.heads
        # Two kinds of each token: for the first view, which is the world, and for all others.
        self.camera_token = nn.Parameter(torch.empty(1, 2, 1, dim))
        self.register_token = nn.Parameter(torch.empty(1, 2, sizes.registers, dim))
        self.patch_embed = VisionTransformer(sizes)
        self.frame_blocks, self.global_blocks = (
            nn.ModuleList(Block(dim, sizes.heads, normed=True) for _ in range(sizes.depth))
            for _ in range(2))

    def begin(self, patches: Tensor, grid: Grid, first: bool) -> Tensor:
        """Patch tokens [N,P,C] through frame block 0: [N,T,C], T = specials + P.

        It depends on nothing but the view and whether it is the window's first: worth keeping.
        """
        kind = 0 if first else 1
        specials = torch.cat([self.camera_token[:, kind], self.register_token[:, kind]], 1)
        x = torch.cat([specials.expand(len(patches), -1, -1), patches], 1)
        return self.frame_blocks[0](x, self._view_turns(grid, x))

    def forward(self, x: Tensor, grid: Grid, layers: Sequence[int],
                views: Sequence[int]) -> Aggregated:
        """x: [N,T,C], what ``begin`` gave for each view. layers, views: what to keep."""
        n = len(x)
        turns, all_turns = self._view_turns(grid, x), self._window_turns(n, grid, x)
        kept: dict[int, Tensor] = {}
        last = len(self.frame_blocks) - 1
        for layer in range(last):
            frame = self.frame_blocks[layer](x, turns) if layer else x
            x = self.global_blocks[layer](frame.flatten(0, 1)[None], all_turns)[0]
            x = x.unflatten(0, (n, -1))
            if layer in layers:
                kept[layer] = torch.cat([chosen(frame, views), chosen(x, views)], -1)
        frame = self.frame_blocks[last](x, turns) if last else x
        return self._finish(frame, turns, all_turns, kept, last in layers, views)

    def _finish(self, frame: Tensor, turns: Tensor, all_turns: Tensor, kept: dict[int, Tensor],
                keep_last: bool, views: Sequence[int]) -> Aggregated:
        """The last global block, for the camera tokens and the views that are kept.

        Nobody reads its other rows. Slices rather than an index: that would wait for the device.
        """
        n, length, _ = frame.shape
        lengths = [length if keep_last and i in views else 1 for i in range(n)]
        rows = torch.cat([frame[i, :m] for i, m in enumerate(lengths)])[None]
        row_turns = torch.cat([turns[:, :m] for m in lengths], 1)
        block = cast(Block, self.global_blocks[-1])
        x = block.for_rows(rows, frame.flatten(0, 1)[None], row_turns, all_turns)
        parts = torch.cat([rows[0], x[0]], -1).split(lengths)
        camera = torch.stack([part[0] for part in parts])
        if keep_last:
            kept[len(self.frame_blocks) - 1] = torch.stack([parts[i] for i in views])
        return Aggregated(camera, kept)

    def _view_turns(self, grid: Grid, like: Tensor) -> Tensor:
        return view_turns(grid.rows, grid.columns, self._specials, self._head_dim,
                          str(like.device))

    def _window_turns(self, views: int, grid: Grid, like: Tensor) -> Tensor:
        return window_turns(views, grid.rows, grid.columns, self._specials, self._head_dim,
                            str(like.device))


def chosen(x: Tensor, views: Sequence[int]) -> Tensor:
    """Some views of x: [N,...]; all in order are x itself."""
    if tuple(views) == tuple(range(len(x))):
        return x
    return torch.stack([x[i] for i in views])
