"""The depth head (DPT): four layers of tokens to depth and confidence of every pixel."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from .fusion import FeatureFusion, resized
from .layers import LayerNorm
from .place_encoding import place_encoding
from .products import PixelLinear
from .sizes import PATCH_PX, VggtSizes

_HIDDEN = 32      # channels before the last layer


class _Scratch(nn.Module):
    """From the pyramid's finest level (1) to its coarsest (4); named as in the checkpoint."""

    def __init__(self, channels: tuple[int, ...], dim: int) -> None:
        super().__init__()
        for level, width in enumerate(channels, 1):
            self.add_module(f'layer{level}_rn', nn.Conv2d(width, dim, 3, padding=1, bias=False))
            self.add_module(f'refinenet{level}', FeatureFusion(dim, merges=level < len(channels)))
        self.output_conv1 = nn.Conv2d(dim, dim // 2, 3, padding=1)
        self.output_conv2 = nn.Sequential(
            nn.Conv2d(dim // 2, _HIDDEN, 3, padding=1), nn.ReLU(inplace=True),
            PixelLinear(_HIDDEN, 2))

    def forward(self, pyramid: list[Tensor]) -> Tensor:
        """Levels 1 to 4, [V,C_i,h_i,w_i], to features [V,dim/2,2*h_1,2*w_1]."""
        narrow = [self.get_submodule(f'layer{level}_rn')(x) for level, x in enumerate(pyramid, 1)]
        sizes = [(2 * narrow[0].shape[-2], 2 * narrow[0].shape[-1])]
        sizes += [(x.shape[-2], x.shape[-1]) for x in narrow]
        x: Tensor | None = None
        for level in (4, 3, 2, 1):
            fuse = self.get_submodule(f'refinenet{level}')
            x = fuse(narrow[level - 1], x, sizes[level - 1])
        return self.output_conv1(x)


class DepthHead(nn.Module):
    """Works on one view after the other: the memory of one view is enough for any window."""

    def __init__(self, sizes: VggtSizes) -> None:
        super().__init__()
        channels = sizes.dpt_channels
        self._specials = sizes.specials
        self.norm = LayerNorm(2 * sizes.dim)
        self.projects = nn.ModuleList(PixelLinear(2 * sizes.dim, c) for c in channels)
        # Four times as fine as the patches, twice, the same, half.
        self.resize_layers = nn.ModuleList([
            nn.ConvTranspose2d(channels[0], channels[0], 4, stride=4),
            nn.ConvTranspose2d(channels[1], channels[1], 2, stride=2),
            nn.Identity(),
            nn.Conv2d(channels[3], channels[3], 3, stride=2, padding=1)])
        self.scratch = _Scratch(channels, sizes.dpt_dim)

    def forward(self, layers: list[Tensor], height: int, width: int) -> tuple[Tensor, Tensor]:
        """layers: four of [V,T,2C], finest level first. Depth and confidence, [V,H,W] each."""
        views = [self._view([tokens[i:i + 1] for tokens in layers], height, width)
                 for i in range(len(layers[0]))]
        depth, confidence = torch.cat(views).unbind(1)
        return depth.exp(), 1.0 + confidence.exp()

    def _view(self, layers: list[Tensor], height: int, width: int) -> Tensor:
        """[1,2,H,W]: logarithms of the depth and of the confidence less one."""
        aspect = width / height
        grid = (height // PATCH_PX, width // PATCH_PX)
        pyramid = []
        for tokens, project, resize in zip(layers, self.projects, self.resize_layers):
            # transposed tokens are an image in channels-last order as they stand
            x = self.norm(tokens[:, self._specials:]).transpose(1, 2).unflatten(2, grid)
            pyramid.append(resize(_placed(project(x), aspect)))
        x = resized(self.scratch(pyramid), (height, width))
        return self.scratch.output_conv2(_placed(x, aspect))


def _placed(x: Tensor, aspect: float) -> Tensor:
    """x, of which nobody else needs the old values, and where its pixels are."""
    return x.add_(place_encoding(x.shape[1], x.shape[2], x.shape[3], aspect, str(x.device)))
