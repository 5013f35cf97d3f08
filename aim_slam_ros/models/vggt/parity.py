"""Is this the official network? Its recorded outputs, compared array by array.

A fixture is a folder with the official implementation's inputs.npy ([N,3,H,W], in 0..1) and
outputs.npz, the weights that gave them, and meta.json with the sizes.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Sequence

import numpy as np
import torch
from torch import Tensor

from ...geometry import camera, sim3
from . import pose_encoding
from .aggregator import Grid
from .loading import load_vggt
from .network import Vggt
from .sizes import PATCH_PX


def compare(folder: Path) -> dict[str, float]:
    """The largest relative difference of every recorded array over three ways to get it: all
    views at once, each view prepared by itself as the cache does, and with the views after the
    first in reverse order. Infinite for an array that is not known here.
    """
    network = load_vggt(folder)
    images = torch.from_numpy(np.load(folder / 'inputs.npy'))
    with np.load(folder / 'outputs.npz') as file:
        expected = {name: torch.from_numpy(file[name]) for name in file.files}
    keep = [int(m[1]) for name in expected if (m := re.fullmatch(r'tokens_(\d+)', name))]
    backwards = [0, *range(len(images) - 1, 0, -1)]
    swapped = arrays(network, images[backwards], keep, together=True)
    runs = [arrays(network, images, keep, together=True),
            arrays(network, images, keep, together=False),
            {name: array[backwards] for name, array in swapped.items()}]
    return {name: max(difference(run[name], array) if name in run else math.inf for run in runs)
            for name, array in expected.items()}


def difference(a: Tensor, b: Tensor) -> float:
    """max |a-b| / max |b|; infinite where the shapes differ or something is not finite."""
    if a.shape != b.shape or not bool(a.isfinite().all()):
        return math.inf
    a, b = a.double(), b.double()
    return float((a - b).abs().max() / b.abs().max())


def arrays(network: Vggt, images: Tensor, keep: Sequence[int],
           together: bool) -> dict[str, Tensor]:
    """Everything that a fixture may hold, by its names there. keep: layers of tokens."""
    height, width = images.shape[-2:]
    grid = Grid(height // PATCH_PX, width // PATCH_PX)
    patches = network.encode(images) if together else \
        torch.cat([network.encode(image[None]) for image in images])
    output = network(begun(network, patches, grid, together), grid, keep=keep)
    encoding = output.pose_rounds[-1]
    T_cam_world = pose_encoding.extrinsics(encoding)
    K = pose_encoding.intrinsics(encoding, height, width)
    found = {'patch_tokens': patches, 'pose_enc': encoding, 'extrinsic': T_cam_world[:, :3],
             'intrinsic': K, 'depth': output.depth[..., None], 'depth_conf': output.confidence,
             'points': _points_world(output.depth, K, T_cam_world)}
    found |= {f'tokens_{layer}': tokens for layer, tokens in output.layers.items()}
    return found | {f'pose_enc_iter{i}': x for i, x in enumerate(output.pose_rounds)}


def begun(network: Vggt, patches: Tensor, grid: Grid, together: bool = True) -> Tensor:
    """[N,P,C] to [N,T,C]: every view after the first frame block; view 0 is the world."""
    others = patches[1:].split(max(1, len(patches)) if together else 1)
    return torch.cat([network.begin(patches[:1], grid, True),
                      *[network.begin(one, grid, False) for one in others if len(one)]])


def _points_world(depth: Tensor, K: Tensor, T_cam_world: Tensor) -> Tensor:
    """[N,H,W,3] float64."""
    T_world_cam = sim3.inverse(T_cam_world.double().cpu()).to(depth.device)
    points = camera.unproject(depth.double(), K.double())
    turned = points.flatten(1, 2) @ T_world_cam[:, :3, :3].mT + T_world_cam[:, None, :3, 3]
    return turned.view_as(points)
