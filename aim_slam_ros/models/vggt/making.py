"""The model that the settings ask for."""

from __future__ import annotations

import logging
from pathlib import Path

import torch

from ...config import Config, ConfigError
from ...devices import chosen_device
from .checkpoint import HOW_TO_GET
from .loading import load_vggt
from .model import VggtModel

_log = logging.getLogger(__name__)
_DTYPES = {'float32': torch.float32, 'bfloat16': torch.bfloat16}


def make_vggt(config: Config) -> VggtModel:
    """Raises ConfigError for settings that this machine cannot meet and for unusable weights."""
    if not config.model.weights:
        raise ConfigError('model.weights: the vggt model needs the path of its weights; '
                          f'{HOW_TO_GET}')
    device = chosen_device('model.device', config.model.device)
    dtype = chosen_dtype(config.vggt.precision, device)
    network = load_vggt(Path(config.model.weights).expanduser(), device, dtype)
    if config.vggt.compile:
        network.compile_blocks()
    if device.type == 'cpu':
        _log.warning('VGGT runs on the CPU: an inference takes tens of seconds')
    return VggtModel(network, config.vggt.cached_frames, config.camera.fov_deg)


def chosen_dtype(name: str, device: torch.device) -> torch.dtype:
    """``auto`` is bfloat16 on a GPU that has it, float32 elsewhere."""
    if name != 'auto':
        return _DTYPES[name]
    fast = device.type == 'cuda' and torch.cuda.is_bf16_supported(including_emulation=False)
    return torch.bfloat16 if fast else torch.float32
