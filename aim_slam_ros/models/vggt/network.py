"""The network, from images to depth, confidence and pose encodings."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Sequence

import torch
from torch import Tensor, nn

from .aggregator import Aggregator, Grid
from .camera_head import CameraHead
from .depth_head import DepthHead
from .layers import Block
from .sizes import PATCH_PX, VggtSizes


@dataclass(frozen=True)
class VggtOutput:
    """N views, of which V were asked for their depth.

    pose_rounds: the pose encodings [N,9] of every round of the camera head, the best one last.
    depth: [V,H,W] > 0. confidence: [V,H,W] > 1. layers: the tokens that were kept, [V,T,2C].
    """

    pose_rounds: list[Tensor]
    depth: Tensor
    confidence: Tensor
    layers: dict[int, Tensor]


class Vggt(nn.Module):
    """VGGT with camera and depth heads, in three steps of which the first two can be kept.

        patches = network.encode(images)                        # once per image
        begun = network.begin(patches, grid, first)             # once per image and role
        output = network(begun_of_all_views, grid)              # once per window

    Nothing in here waits for the device: no value of a tensor is looked at.
    """

    def __init__(self, sizes: VggtSizes = VggtSizes()) -> None:
        super().__init__()
        self.sizes = sizes
        self.aggregator = Aggregator(sizes)
        self.camera_head = CameraHead(sizes)
        self.depth_head = DepthHead(sizes)

    @property
    def device(self) -> torch.device:
        return self.aggregator.camera_token.device

    def encode(self, images: Tensor) -> Tensor:
        """Images [N,3,H,W] in 0..1 (sides multiples of 14) to patch tokens [N,P,C] float32."""
        mean, deviation = _imagenet(str(images.device))
        return self.aggregator.patch_embed((images - mean) / deviation)

    def begin(self, patches: Tensor, grid: Grid, first: bool) -> Tensor:
        """Patch tokens [N,P,C] to [N,T,C]; ``first``: of the view that is the window's world."""
        return self.aggregator.begin(patches, grid, first)

    def forward(self, begun: Tensor, grid: Grid, depth_views: Sequence[int] | None = None,
                keep: Sequence[int] = ()) -> VggtOutput:
        """begun: [N,T,C], the first view first. depth_views: None for all. keep: more layers."""
        views = range(len(begun)) if depth_views is None else depth_views
        wanted = (*self.sizes.dpt_layers, *keep) if len(views) else ()
        tokens = self.aggregator(begun, grid, wanted, views)
        # The heads are float32 even where the caller has switched autocast on.
        with torch.autocast('cuda' if begun.is_cuda else 'cpu', enabled=False):
            rounds = self.camera_head(tokens.camera)
            depth, confidence = self._depth(tokens.layers, grid)
        return VggtOutput(rounds, depth, confidence, tokens.layers)

    def _depth(self, layers: dict[int, Tensor], grid: Grid) -> tuple[Tensor, Tensor]:
        height, width = grid.rows * PATCH_PX, grid.columns * PATCH_PX
        if not layers:
            none = torch.empty(0, height, width, device=self.device)
            return none, none
        return self.depth_head([layers[i] for i in self.sizes.dpt_layers], height, width)

    def set_transformer_dtype(self, dtype: torch.dtype) -> None:
        """The dtype that the aggregator multiplies in; the heads stay in float32."""
        for module in self.aggregator.modules():
            if isinstance(module, (nn.Linear, nn.Conv2d)):
                module.to(dtype)

    def compile_blocks(self, backend: str = 'inductor') -> None:
        """Every block through torch.compile at its first use; blocks of a kind share their code
        since each is compiled by itself.
        """
        for module in self.aggregator.modules():
            if isinstance(module, Block):
                module.compile(backend=backend)


@lru_cache(maxsize=4)
def _imagenet(device: str) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of ImageNet's colours, [3,1,1] each."""
    return (torch.tensor([0.485, 0.456, 0.406], device=device)[:, None, None],
            torch.tensor([0.229, 0.224, 0.225], device=device)[:, None, None])
