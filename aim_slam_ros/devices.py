"""Where tensors live and dense work is done."""

from __future__ import annotations

import torch

from .settings import ConfigError


def chosen_device(setting: str, name: str) -> torch.device:
    """The device that a setting names; ``auto`` is the GPU where there is one.

    Raises ConfigError, which names the setting, for what is no device or not there.
    """
    if name == 'auto':
        return torch.device('cuda' if torch.cuda.is_available() else 'cpu')
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise ConfigError(f'{setting}: {name!r} is not allowed; expected auto, cpu, cuda or '
                          'cuda:N') from error
    if device.type == 'cuda' and (device.index or 0) >= torch.cuda.device_count():
        raise ConfigError(f'{setting}: {name} is not there: torch {torch.__version__} sees '
                          f'{torch.cuda.device_count()} CUDA GPUs. Set it to cpu, or install the '
                          "GPU's driver and a CUDA build of torch")
    return device
