"""A network with the weights of a checkpoint, by the checkpoint's own names."""

from __future__ import annotations

from pathlib import Path
from typing import Mapping

import torch
from torch import Tensor
from torch.nn.utils.memory_format import convert_conv2d_weight_memory_format

from .checkpoint import HOW_TO_GET, Checkpoint, CheckpointError, open_checkpoint, weights_file
from .network import Vggt
from .sizes import SizesError, VggtSizes, sizes_from_meta

_NAMED = 3    # tensors that an error names

# What a file may be instead, by the beginnings of the names in it; the first that fits is said.
_KNOWN = (
    (('aggregator.', 'camera_head.', 'depth_head.'), 'a VGGT of another kind or size; sizes other '
     "than VGGT-1B's are read from a meta.json beside the file"),
    (('aggregator.',), 'a VGGT without camera or depth head'),
    (('enc_blocks.', 'dec_blocks.'), 'DUSt3R or MASt3R'),
    (('cls_token', 'blocks.'), 'a vision transformer alone, such as DINOv2'),
    (('model.backbone.',), 'Depth Anything 3'),
    (('info_sharing.',), 'MapAnything'),
    (('encoder.', 'decoder.'), 'Pi3 or another encoder-decoder model'))


def load_vggt(path: Path | str, device: torch.device | str = 'cpu',
              dtype: torch.dtype = torch.float32, config: VggtSizes | None = None) -> Vggt:
    """The network, ready to run on the device, with its transformer in this dtype.

    path: a file or a folder with one. config: sizes; without them those of a meta.json beside the
    file, or else VGGT-1B's. Every tensor is read once, straight into the dtype it runs in; those
    of the point and track heads are not read. On the CPU in float32 they stay memory-mapped.
    Raises CheckpointError.
    """
    file = weights_file(Path(path))
    network = empty_network(config) if config else network_for(file)
    network.set_transformer_dtype(dtype)
    checkpoint = open_checkpoint(file)
    wanted = network.state_dict()
    check_names(file, checkpoint, wanted)
    state = {name: checkpoint.tensor(name).to(device, like.dtype)
             for name, like in wanted.items()}
    network.load_state_dict(state, assign=True)
    return prepared(network)


def empty_network(sizes: VggtSizes) -> Vggt:
    """Names and shapes without memory: on the meta device."""
    with torch.device('meta'):
        return Vggt(sizes)


def network_for(file: Path) -> Vggt:
    """Empty, of the sizes in the meta.json beside the file, or else VGGT-1B's."""
    meta = file.with_name('meta.json')
    try:
        return empty_network(sizes_from_meta(meta) if meta.is_file() else VggtSizes())
    except SizesError as error:
        raise CheckpointError(str(error)) from error


def prepared(network: Vggt) -> Vggt:
    """For inference only; convolutions in the layout that is fast on both CPU and GPU."""
    convert_conv2d_weight_memory_format(network.depth_head, torch.channels_last)
    return network.requires_grad_(False).eval()


def check_names(file: Path, checkpoint: Checkpoint, wanted: Mapping[str, Tensor]) -> None:
    """Raises CheckpointError where a tensor is missing or has another shape."""
    shapes = checkpoint.shapes
    missing = [name for name in wanted if name not in shapes]
    if missing:
        raise CheckpointError(f'{file} is not the VGGT that is wanted: {len(missing)} of '
                              f'{len(wanted)} tensors are missing ({_some(missing)}). It seems to '
                              f'be {_seems(shapes)}. The right weights: {HOW_TO_GET}')
    misshapen = [f'{name} {shapes[name]} instead of {tuple(like.shape)}'
                 for name, like in wanted.items() if shapes[name] != tuple(like.shape)]
    if misshapen:
        raise CheckpointError(f'{file} is a VGGT of other sizes: {len(misshapen)} tensors have '
                              f'another shape ({_some(misshapen)}). Sizes other than those of '
                              'VGGT-1B are read from a meta.json beside the file')


def _some(items: list[str]) -> str:
    return ', '.join(items[:_NAMED]) + (', ...' if len(items) > _NAMED else '')


def _seems(shapes: Mapping[str, tuple[int, ...]]) -> str:
    for beginnings, what in _KNOWN:
        if all(any(name.startswith(b) for name in shapes) for b in beginnings):
            return what
    first = sorted({name.split('.')[0] for name in shapes})
    return f'something unknown, with {_some(first)}' if first else 'without any tensor'
