"""A network with random weights, for measurements and tests: what it sees means nothing."""

from __future__ import annotations

import math

import torch

from .loading import empty_network, prepared
from .network import Vggt
from .sizes import VggtSizes

# Small enough for tests; everything is there that the full size has.
TINY = VggtSizes(image_size=112, dim=64, vit_depth=2, vit_heads=4, depth=4, heads=4,
                 camera_depth=2, camera_heads=4, dpt_dim=16, dpt_channels=(16, 24, 32, 32),
                 dpt_layers=(0, 1, 2, 3))
_SCALE = 0.1    # of each block's contribution, so that every one is seen and none explodes


def random_network(sizes: VggtSizes, seed: int = 0) -> Vggt:
    """On the CPU, in float32; outputs depend on every layer and stay finite."""
    network = empty_network(sizes).to_empty(device='cpu')
    generator = torch.Generator().manual_seed(seed)
    for name, parameter in network.requires_grad_(False).named_parameters():
        if name.endswith('gamma'):
            parameter.fill_(_SCALE)
        elif name.endswith('.bias'):
            parameter.zero_()
        elif parameter.dim() == 1:      # of a norm
            parameter.fill_(1.0)
        else:
            spread = 1.0 / math.sqrt(parameter[0].numel())
            parameter.normal_(0.0, spread, generator=generator)
    # Fields of view of about 1 rad, so that cameras are cameras.
    network.camera_head.pose_branch.fc2.weight[7:] *= 0.02
    network.camera_head.pose_branch.fc2.bias[7:] = 1.0 / sizes.camera_iterations
    return prepared(network)
