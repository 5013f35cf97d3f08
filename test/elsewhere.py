"""A stand-in for a GPU where there is none: tensors that live elsewhere and compute on the CPU.

Inside ``Elsewhere`` the device 'meta' holds values. As with CUDA, an operation on tensors of two
devices is refused, and so is a look at the values from numpy; what is computed is what the CPU
computes, bit for bit. It shows that code follows its tensors' device, not that a GPU is fast.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

DEVICE = torch.device('meta')
# CUDA takes indices that are on the CPU; aten's names of what indexing calls.
_INDEXING = ('aten::index', 'aten::index_put', 'aten::index_put_')
_COPYING = ('aten::_to_copy', 'aten::copy_')


class MixedDevices(RuntimeError):
    """As torch says of CUDA: expected all tensors to be on the same device."""


class _There(Tensor):
    """A tensor of the other device; its values are in ``here``."""

    here: Tensor

    @staticmethod
    def __new__(cls, here: Tensor) -> _There:
        there = Tensor._make_wrapper_subclass(
            cls, here.size(), strides=here.stride(), storage_offset=here.storage_offset(),
            dtype=here.dtype, device=DEVICE)
        there.here = here
        return there

    def __getitem__(self, index: Any) -> Tensor:
        return super().__getitem__(_indices(index))

    def __setitem__(self, index: Any, value: Any) -> None:
        super().__setitem__(_indices(index), value)

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any,  # type: ignore[override]
                           args: Any = (), kwargs: Any = None) -> Any:
        raise MixedDevices(f'{func} outside of Elsewhere')


class Elsewhere(TorchDispatchMode):
    """operations: how many were computed there, of whatever size."""

    def __init__(self) -> None:
        super().__init__()
        self.operations = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (),
                           kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        name = func.name().split('.')[0]
        tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
        there = any(isinstance(tensor, _There) for tensor in tensors)
        assert all(isinstance(t, _There) for t in tensors if t.device == DEVICE), \
            f'{name} of a tensor that torch made on {DEVICE} by itself: its values are lost'
        if there:
            self._check(name, tensors)
        device = kwargs.get('device')
        if device is not None:
            kwargs['device'] = torch.device('cpu')
            there = torch.device(device) == DEVICE
        self.operations += there
        result = func(*tree_map(_brought, args), **tree_map(_brought, kwargs))
        if func._schema.is_mutable or not there:
            return args[0] if func._schema.is_mutable and result is not None else result
        return tree_map(_sent, result)

    def _check(self, name: str, tensors: list[Tensor]) -> None:
        """A number on the CPU may meet tensors from elsewhere, nothing larger may."""
        if name in _COPYING:
            return
        strangers = [t for t in tensors if not isinstance(t, _There) and t.dim() > 0]
        if name in _INDEXING and isinstance(tensors[0], _There):
            strangers = [t for t in strangers if t.dtype not in (torch.int64, torch.bool)]
        if strangers:
            raise MixedDevices(f'{name} of tensors on two devices, one of shape '
                               f'{tuple(strangers[0].shape)} on the CPU')


def _indices(index: Any) -> Any:
    """Torch itself would put lists and arrays on the device, where their values are lost."""
    parts = index if isinstance(index, tuple) else (index,)
    return tuple(torch.as_tensor(part) if isinstance(part, (list, np.ndarray)) else part
                 for part in parts)


def _brought(value: Any) -> Any:
    return value.here if isinstance(value, _There) else value


def _sent(value: Any) -> Any:
    return _There(value) if isinstance(value, Tensor) else value
