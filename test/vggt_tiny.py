"""A tiny VGGT with random weights, its checkpoint, and where the official fixture is."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor

from aim_slam_ros.models.vggt.aggregator import Grid
from aim_slam_ros.models.vggt.network import Vggt
from aim_slam_ros.models.vggt.synthetic import TINY, random_network
from aim_slam_ros.types import Frame

FIXTURES = Path(__file__).resolve().parents[2] / 'shared' / 'vggt_parity'
HEIGHT, WIDTH = 84, 112
GRID = Grid(HEIGHT // 14, WIDTH // 14)
META: dict[str, Any] = {'kind': 'tiny', 'tiny': {
    'img_size': TINY.image_size, 'patch_size': 14, 'embed_dim': TINY.dim, 'depth': TINY.depth,
    'num_heads': TINY.heads, 'vit_dim': TINY.dim, 'vit_depth': TINY.vit_depth,
    'vit_heads': TINY.vit_heads, 'features': TINY.dpt_dim, 'out_channels': TINY.dpt_channels,
    'dpt_layers': TINY.dpt_layers, 'cam_trunk_depth': TINY.camera_depth,
    'cam_heads': TINY.camera_heads}}


def fixture_path(name: str) -> Path:
    """A file or folder of the official fixture, or a skip that says so."""
    path = FIXTURES / name
    if not path.exists():
        pytest.skip(f'the parity fixture {path} is not here')
    return path


def images(views: int = 3, seed: int = 0) -> Tensor:
    """[N,3,H,W] in 0..1."""
    return torch.rand(views, 3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(seed))


def frame(seed: int = 0, K: Tensor | None = None,
          size: tuple[int, int] = (HEIGHT, WIDTH)) -> Frame:
    image = np.random.default_rng(seed).integers(0, 256, (*size, 3)).astype(np.uint8)
    return Frame(seed, image, K)


def state(network: Vggt) -> dict[str, Tensor]:
    return {name: tensor.contiguous() for name, tensor in network.state_dict().items()}


def write_checkpoint(folder: Path, network: Vggt | None = None) -> Path:
    """weights.safetensors and meta.json; the path of the former."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / 'meta.json').write_text(json.dumps(META), encoding='utf-8')
    path = folder / 'weights.safetensors'
    save_file(state(network or random_network(TINY)), path)
    return path
