"""The parts that the whole transformer is made of.

Precision: a ``Linear`` computes in the dtype of its own weights; everything between (residual
sums, norms, rotations) stays in float32. That is what autocast does with float32 weights, without
casting them at every call.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .products import Linear, attention, linear
from .rope import rotated

_ROWS = 1100    # of hidden activations at a time on the CPU: 18 MB at full size


class LayerNorm(nn.LayerNorm):
    """In float32, whatever comes in."""

    def forward(self, x: Tensor) -> Tensor:
        return F.layer_norm(x.float(), self.normalized_shape, self.weight, self.bias, self.eps)


class LayerScale(nn.Module):
    """A learned factor for each channel of what a residual sum adds."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.empty(dim))

    def forward(self, x: Tensor, change: Tensor) -> Tensor:
        """x + gamma * change."""
        return torch.addcmul(x, change, self.gamma)


class Mlp(nn.Module):
    """Two linear layers with a GELU between them."""

    def __init__(self, dim: int, hidden: int, out: int) -> None:
        super().__init__()
        self.fc1 = Linear(dim, hidden)
        self.fc2 = Linear(hidden, out)

    def forward(self, x: Tensor) -> Tensor:
        """On the CPU in portions: fresh memory costs more there than what is done with it, and
        small tensors get what others have left.
        """
        portions = -(-x.shape[:-1].numel() // _ROWS) if x.is_cpu else 1
        if portions == 1:
            return self._portion(x)
        parts = x.flatten(0, -2).chunk(portions)
        return torch.cat([self._portion(part) for part in parts]).view(*x.shape[:-1], -1)

    def _portion(self, x: Tensor) -> Tensor:
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
        """turns: [2,T,C/heads], see rope.py."""
        return self.for_rows(x, x, turns, turns)

    def for_rows(self, rows: Tensor, x: Tensor, row_turns: Tensor | None,
                 turns: Tensor | None) -> Tensor:
        """What ``forward`` gives for some rows [B,R,C] of x, without computing the others."""
        q = _turned(self.q_norm(self._part(0, rows)), row_turns)
        k = _turned(self.k_norm(self._part(1, x)), turns)
        v = self._part(2, x)
        return self.proj(attention(q.to(v.dtype), k.to(v.dtype), v).flatten(2))

    def _part(self, part: int, x: Tensor) -> Tensor:
        """Queries (0), keys (1) or values (2) of x [B,T,C]: [B,T,heads,C/heads].

        By itself each is contiguous, as the norms want it.
        """
        channels = slice(part * x.shape[-1], (part + 1) * x.shape[-1])
        y = linear(x, self.qkv.weight[channels], self.qkv.bias[channels])
        return y.unflatten(-1, (self._heads, -1))


def _turned(x: Tensor, turns: Tensor | None) -> Tensor:
    """x: [B,T,heads,D]."""
    return x if turns is None else rotated(x, turns[:, :, None])


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
        x = self.ls1(x, self.attn(self.norm1(x), turns))
        return self.ls2(x, self.mlp(self.norm2(x)))

    def for_rows(self, rows: Tensor, x: Tensor, row_turns: Tensor, turns: Tensor) -> Tensor:
        """What ``forward`` gives for some rows [B,R,C] of x."""
        out = self.attn.for_rows(self.norm1(rows), self.norm1(x), row_turns, turns)
        rows = self.ls1(rows, out)
        return self.ls2(rows, self.mlp(self.norm2(rows)))
