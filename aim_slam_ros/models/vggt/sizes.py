"""The sizes of a network; the default is VGGT-1B."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Mapping

PATCH_PX = 14

# Names of the sizes in a meta.json that our field names replace.
_META = {
    'img_size': 'image_size', 'embed_dim': 'dim', 'depth': 'depth', 'num_heads': 'heads',
    'vit_depth': 'vit_depth', 'vit_heads': 'vit_heads', 'features': 'dpt_dim',
    'out_channels': 'dpt_channels', 'dpt_layers': 'dpt_layers',
    'cam_trunk_depth': 'camera_depth', 'cam_heads': 'camera_heads'}


class SizesError(ValueError):
    """A meta.json that describes no network of this kind."""


@dataclass(frozen=True)
class VggtSizes:
    """image_size: side of the square image, in pixels, that the position embedding was made for.

    dim: of a token. vit_depth, depth, camera_depth: blocks of the patch embedding, pairs of blocks
    of the aggregator, blocks of the camera head; each with its number of attention heads.
    registers: register tokens of the patch embedding and, as many again, of the aggregator.
    dpt_layers: the pairs of blocks whose tokens the depth head reads; dpt_channels: what it makes
    of each; dpt_dim: its inner width.
    """

    image_size: int = 518
    dim: int = 1024
    vit_depth: int = 24
    vit_heads: int = 16
    depth: int = 24
    heads: int = 16
    registers: int = 4
    camera_depth: int = 4
    camera_heads: int = 16
    camera_iterations: int = 4
    dpt_dim: int = 256
    dpt_channels: tuple[int, int, int, int] = (256, 512, 1024, 1024)
    dpt_layers: tuple[int, int, int, int] = (4, 11, 17, 23)

    def __post_init__(self) -> None:
        if self.image_size % PATCH_PX:
            raise SizesError(f'an image size of {self.image_size} is no multiple of {PATCH_PX}')
        # Half of a head's channels turn with the row, half with the column, in pairs.
        if self.dim % self.vit_heads or self.dim % (4 * self.heads):
            raise SizesError(f'{self.dim} channels do not divide into the attention heads')
        if len(self.dpt_layers) != 4 or not all(0 <= i < self.depth for i in self.dpt_layers):
            raise SizesError(f'dpt_layers {self.dpt_layers} are not four of {self.depth} layers')

    @property
    def specials(self) -> int:
        """Tokens in front of an image's patches: the camera token and the registers."""
        return 1 + self.registers


def sizes_from_meta(path: Path) -> VggtSizes:
    """What a meta.json says; the default where it says nothing. Raises SizesError."""
    try:
        meta = json.loads(path.read_text(encoding='utf-8'))
        sizes = meta.get(meta.get('kind', ''), {})
        return _sizes(sizes) if sizes else VggtSizes()
    except (OSError, ValueError, AttributeError, TypeError) as error:
        raise SizesError(f'{path} does not describe the sizes of a network: {error}') from error


def _sizes(meta: Mapping[str, Any]) -> VggtSizes:
    if meta.get('patch_size', PATCH_PX) != PATCH_PX:
        raise SizesError(f'patches of {meta["patch_size"]} pixels are not supported')
    if meta.get('vit_dim', meta.get('embed_dim')) != meta.get('embed_dim'):
        raise SizesError('patch embedding and aggregator must have the same width')
    values: dict[str, Any] = {ours: meta[name] for name, ours in _META.items() if name in meta}
    for name, value in values.items():
        if isinstance(value, list):
            values[name] = tuple(value)
    return VggtSizes(**values)
