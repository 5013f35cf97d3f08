"""The two products of a transformer, on the CPU by the library that is fast there.

For float32 torch multiplies matrices with MKL and convolves with oneDNN. On the AVX-512 CPU at
hand, which is not Intel's, MKL reached half of oneDNN's speed, 100 against 220 GFLOP/s. Tokens
are the pixels of an image one pixel high, and a convolution with a kernel of one pixel is a linear
layer: the same sums in another order. The dilation, without effect on a single pixel, is what
makes torch choose oneDNN for such a kernel on one thread too.
"""

from __future__ import annotations

import itertools

import torch
import torch.nn.functional as F
from torch import Tensor, nn

# Where it was measured; elsewhere nothing is known, and nothing changes.
_BY_CONVOLUTION = (torch.backends.mkldnn.is_available()
                   and torch.backends.cpu.get_cpu_capability() == 'AVX512')
_MANY_ROWS = 128    # fewer do not pay for arranging the weights
_QUERIES = 640      # at a time: their scores still fit into a cache


def linear(x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
    """x: [...,C] to [...,D], computed in the dtype of the weights [D,C]."""
    x = x.to(weight.dtype)
    if _pays(x, x.shape[:-1].numel()):
        return _by_convolution(x, weight, bias)
    return F.linear(x, weight, bias)


def attention(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
    """softmax(q k^T / sqrt(D)) v for each head: [B,R,H,D] and twice [B,T,H,D] to [B,R,H,D]."""
    if not _pays(q, q.shape[1]):
        return F.scaled_dot_product_attention(q.transpose(1, 2), k.transpose(1, 2),
                                              v.transpose(1, 2)).transpose(1, 2)
    out = torch.empty_like(q)
    portions = -(-q.shape[1] // _QUERIES)
    for view, head in itertools.product(range(q.shape[0]), range(q.shape[2])):
        keys = k[view, :, head] / q.shape[-1] ** 0.5
        values = v[view, :, head].T.contiguous()
        for queries, found in zip(q[view, :, head].chunk(portions),
                                  out[view, :, head].chunk(portions)):
            found[:] = linear(linear(queries, keys, None).softmax(-1), values, None)
    return out


def _pays(x: Tensor, rows: int) -> bool:
    return _BY_CONVOLUTION and x.is_cpu and x.dtype == torch.float32 and rows >= _MANY_ROWS


def _by_convolution(x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
    pixels = x.reshape(1, 1, -1, x.shape[-1]).permute(0, 3, 1, 2)
    out = F.conv2d(pixels, weight[:, :, None, None], bias, dilation=2)
    return out.permute(0, 2, 3, 1).reshape(*x.shape[:-1], -1)


class Linear(nn.Linear):
    """Casts what comes in to the dtype of its weights."""

    def forward(self, x: Tensor) -> Tensor:
        return linear(x, self.weight, self.bias)


class PixelLinear(nn.Conv2d):
    """A linear layer over the channels of every pixel, with the names and shapes of a convolution
    with a kernel of one pixel: [N,C,H,W] to [N,D,H,W], channels-last.
    """

    def __init__(self, channels: int, out: int) -> None:
        super().__init__(channels, out, 1)

    def forward(self, x: Tensor) -> Tensor:
        return linear(x.permute(0, 2, 3, 1), self.weight.flatten(1), self.bias).permute(0, 3, 1, 2)
