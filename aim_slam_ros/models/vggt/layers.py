"""The parts that the whole transformer is made of.

Precision: a ``Linear`` computes in the dtype of its own weights; everything between (residual
sums, norms, rotations) stays in float32. That is what autocast does with float32 weights, without
casting them at every call.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .rope import rotated


class Linear(nn.Linear):
    """Casts what comes in to the dtype of its weights."""

    def forward(self, x: Tensor) -> Tensor:
        return F.linear(x.to(self.weight.dtype), self.weight, self.bias)


class LayerNorm(nn.LayerNorm):
    """In float32, whatever comes in."""

    def forward(self, x: Tensor) -> Tensor:
        return F.layer_norm(x.float(), self.normalized_shape, self.weight, self.bias, self.eps)


class LayerScale(nn.Module):
    """A learned factor for each channel."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.empty(dim))

    def forward(self, x: Tensor) -> Tensor:
        return x * self.gamma


class Mlp(nn.Module):
    """Two linear layers with a GELU between them."""

    def __init__(self, dim: int, hidden: int, out: int) -> None:
        super().__init__()
        self.fc1 = Linear(dim, hidden)
        self.fc2 = Linear(hidden, out)

    def forward(self, x: Tensor) -> Tensor:
        return self.fc2(F.gelu(self.fc1(x)))


class Attention(nn.Module):
    """Self-attention over the tokens [B,T,C]; ``normed``: queries and keys pass a LayerNorm."""

    def __init__(self, dim: int, heads: int, normed: bool) -> None:
        super().__init__()
        self._heads = heads
        self.qkv = Linear(dim, 3 * dim)
        self.q_norm: nn.Module = LayerNorm(dim // heads) if normed else nn.Identity()
        self.k_norm: nn.Module = LayerNorm(dim // heads) if normed else nn.Identity()
        self.proj = Linear(dim, dim)

    def forward(self, x: Tensor, turns: Tensor | None) -> Tensor:
        q, k, v = self._split(self.qkv(x), 3)
        return self._attend(q, k, v, turns, turns)

    def for_rows(self, rows: Tensor, x: Tensor, row_turns: Tensor, turns: Tensor) -> Tensor:
        """What ``forward`` gives for some rows [B,R,C] of x, without computing the others."""
        dim = x.shape[-1]
        weight, bias = self.qkv.weight, self.qkv.bias
        rows, x = rows.to(weight.dtype), x.to(weight.dtype)
        q, = self._split(F.linear(rows, weight[:dim], bias[:dim]), 1)
        k, v = self._split(F.linear(x, weight[dim:], bias[dim:]), 2)
        return self._attend(q, k, v, row_turns, turns)

    def _split(self, x: Tensor, parts: int) -> tuple[Tensor, ...]:
        """[B,T,parts*C] to ``parts`` tensors [B,heads,T,C/heads]."""
        return x.unflatten(-1, (parts, self._heads, -1)).permute(2, 0, 3, 1, 4).unbind()

    def _attend(self, q: Tensor, k: Tensor, v: Tensor, q_turns: Tensor | None,
                k_turns: Tensor | None) -> Tensor:
        q, k = self.q_norm(q), self.k_norm(k)
        if q_turns is not None and k_turns is not None:
            q, k = rotated(q, q_turns), rotated(k, k_turns)
        x = F.scaled_dot_product_attention(q.to(v.dtype), k.to(v.dtype), v)
        return self.proj(x.transpose(1, 2).flatten(2))


class Block(nn.Module):
    """Pre-norm attention and MLP, each scaled and added to the residual stream.

    eps: of the two norms; 1e-6 in the patch embedding, 1e-5 elsewhere.
    """

    def __init__(self, dim: int, heads: int, normed: bool = False, eps: float = 1e-5) -> None:
        super().__init__()
        self.norm1 = LayerNorm(dim, eps=eps)
        self.attn = Attention(dim, heads, normed)
        self.ls1 = LayerScale(dim)
        self.norm2 = LayerNorm(dim, eps=eps)
        self.mlp = Mlp(dim, 4 * dim, dim)
        self.ls2 = LayerScale(dim)

    def forward(self, x: Tensor, turns: Tensor | None = None) -> Tensor:
        """x: [B,T,C] float32. turns: [2,T,C/heads], see rope.py."""
        x = x + self.ls1(self.attn(self.norm1(x), turns))
        return x + self.ls2(self.mlp(self.norm2(x)))

    def for_rows(self, rows: Tensor, x: Tensor, row_turns: Tensor, turns: Tensor) -> Tensor:
        """What ``forward`` gives for some rows [B,R,C] of x."""
        out = self.attn.for_rows(self.norm1(rows), self.norm1(x), row_turns, turns)
        rows = rows + self.ls1(out)
        return rows + self.ls2(self.mlp(self.norm2(rows)))
