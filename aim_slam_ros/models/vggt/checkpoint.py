"""Files with weights: .safetensors and .pt, memory-mapped, told apart by their content."""

from __future__ import annotations

import json
import pickle
from pathlib import Path
from typing import Mapping, Protocol

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from ...config import ConfigError

HOW_TO_GET = 'get them with `ros2 run aim_slam_ros download_weights`'
_NAMES = ('model.safetensors', 'weights.safetensors', 'model.pt')
_MAX_HEADER = 100_000_000    # bytes; the format's own limit


class CheckpointError(ConfigError):
    """A file that is no usable checkpoint; the text says what it seems to be and what to do."""


class Checkpoint(Protocol):
    """Tensors by name; none is read before it is asked for."""

    @property
    def shapes(self) -> Mapping[str, tuple[int, ...]]:
        """Of every tensor."""

    def tensor(self, name: str) -> Tensor:
        """On the CPU."""


def weights_file(path: Path) -> Path:
    """The file itself, or the one with weights in a folder. Raises CheckpointError."""
    if path.is_dir():
        found = [path / name for name in _NAMES if (path / name).is_file()]
        found = found or sorted([*path.glob('*.safetensors'), *path.glob('*.pt')])
        if not found:
            raise CheckpointError(f'{path} holds no .safetensors and no .pt file: {HOW_TO_GET}')
        return found[0]
    if not path.is_file():
        raise CheckpointError(f'there are no weights at {path}: {HOW_TO_GET}')
    return path


def open_checkpoint(path: Path) -> Checkpoint:
    """Open a file with weights. Raises CheckpointError."""
    try:
        size = path.stat().st_size
        with path.open('rb') as file:
            start = file.read(512)
    except OSError as error:
        raise CheckpointError(f'{path} cannot be read: {error.strerror}') from error
    _refuse_text(path, start)
    if start[:4] == b'PK\x03\x04':
        return _Pickled(path)
    if start[8:9] == b'{':
        return _Safetensors(path, size, int.from_bytes(start[:8], 'little'))
    raise CheckpointError(f'{path} is neither a .safetensors nor a .pt file: {HOW_TO_GET}')


def _refuse_text(path: Path, start: bytes) -> None:
    text = start.lstrip().lower()
    if not start:
        raise CheckpointError(f'{path} is empty: {HOW_TO_GET}')
    if text.startswith((b'<!doctype', b'<html', b'<?xml', b'<head')):
        raise CheckpointError(f'{path} is an HTML page, not a checkpoint: its download met a page '
                              f'that asks for a login or a licence; {HOW_TO_GET}')
    if text.startswith(b'version https://git-lfs'):
        raise CheckpointError(f'{path} is a Git LFS pointer, not a checkpoint: fetch the file '
                              f'itself with `git lfs pull`, or {HOW_TO_GET}')


def _truncated(path: Path, detail: object) -> CheckpointError:
    return CheckpointError(f'{path} is damaged, most likely an incomplete download ({detail}): '
                           'download it again')


class _Safetensors:
    def __init__(self, path: Path, size: int, header: int) -> None:
        self._path = path
        _check_end(path, size, header)
        try:
            self._file = safe_open(path, framework='pt')
        except SafetensorError as error:
            raise _truncated(path, error) from error
        self.shapes = {name: tuple(self._file.get_slice(name).get_shape())
                       for name in self._file.keys()}

    def tensor(self, name: str) -> Tensor:
        return self._file.get_tensor(name)


def _check_end(path: Path, size: int, header: int) -> None:
    """The library's own message for a short file does not say that it is short."""
    if header > min(_MAX_HEADER, size - 8):
        raise _truncated(path, f'{size} bytes, shorter than its own header')
    try:
        with path.open('rb') as file:
            file.seek(8)
            table = json.loads(file.read(header))
        end = max((entry['data_offsets'][1] for name, entry in table.items()
                   if name != '__metadata__'), default=0)
    except (ValueError, KeyError, TypeError, IndexError, AttributeError) as error:
        raise CheckpointError(f'{path} has no readable .safetensors header ({error}): '
                              f'{HOW_TO_GET}') from error
    if 8 + header + end > size:
        raise _truncated(path, f'{size} of {8 + header + end} bytes')


class _Pickled:
    def __init__(self, path: Path) -> None:
        try:
            state = torch.load(path, map_location='cpu', weights_only=True, mmap=True)
        except pickle.UnpicklingError as error:
            raise CheckpointError(
                f'{path} holds more than tensors and is not loaded, since that could run foreign '
                'code: save its state_dict alone, or take a .safetensors file') from error
        except (RuntimeError, EOFError, OSError) as error:
            raise _truncated(path, str(error).splitlines()[0]) from error
        if isinstance(state, dict) and isinstance(state.get('model'), dict):
            state = state['model']      # as training scripts save it
        if not isinstance(state, dict):
            raise CheckpointError(f'{path} holds a {type(state).__name__}, not a state_dict')
        self._tensors = {name: tensor for name, tensor in state.items()
                         if isinstance(tensor, Tensor)}
        self.shapes = {name: tuple(tensor.shape) for name, tensor in self._tensors.items()}

    def tensor(self, name: str) -> Tensor:
        return self._tensors[name]
