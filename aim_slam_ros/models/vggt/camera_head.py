"""The camera head: poses and fields of view from the views' camera tokens, refined in rounds."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .layers import Block, LayerNorm, Mlp
from .products import Linear
from .sizes import VggtSizes

POSE_SIZE = 9     # translation, quaternion, two fields of view; see pose_encoding.py
_FOV = 7          # where the fields of view begin
_ADAPTIVE_EPS = 1e-6


class CameraHead(nn.Module):
    """Every round lets the last estimate modulate the tokens and adds a correction to it."""

    def __init__(self, sizes: VggtSizes) -> None:
        super().__init__()
        dim = 2 * sizes.dim
        self._iterations = sizes.camera_iterations
        self.empty_pose_tokens = nn.Parameter(torch.empty(1, 1, POSE_SIZE))
        self.trunk = nn.ModuleList(
            Block(dim, sizes.camera_heads) for _ in range(sizes.camera_depth))
        self.token_norm = LayerNorm(dim)
        self.trunk_norm = LayerNorm(dim)
        self.embed_pose = Linear(POSE_SIZE, dim)
        self.poseLN_modulation = nn.Sequential(nn.SiLU(), Linear(dim, 3 * dim))
        self.pose_branch = Mlp(dim, dim // 2, POSE_SIZE)

    def forward(self, tokens: Tensor) -> list[Tensor]:
        """tokens: [N,2C] to the pose encodings [N,9] of every round, the last being the best."""
        tokens = self.token_norm(tokens)[None]
        plain = F.layer_norm(tokens, tokens.shape[-1:], eps=_ADAPTIVE_EPS)
        estimate = self.empty_pose_tokens.expand(1, tokens.shape[1], -1)
        raw = torch.zeros_like(estimate)
        rounds = []
        for _ in range(self._iterations):
            raw = raw + self._correction(tokens, plain, estimate)
            estimate = raw
            rounds.append(_activated(raw[0]))
        return rounds

    def _correction(self, tokens: Tensor, plain: Tensor, estimate: Tensor) -> Tensor:
        """[1,N,9]. plain: the tokens, normalised."""
        shift, scale, gate = self.poseLN_modulation(self.embed_pose(estimate)).chunk(3, -1)
        x = tokens + gate * (plain * (1.0 + scale) + shift)
        for block in self.trunk:
            x = block(x)
        return self.pose_branch(self.trunk_norm(x))


def _activated(raw: Tensor) -> Tensor:
    """A field of view is not negative."""
    return torch.cat([raw[:, :_FOV], raw[:, _FOV:].relu()], -1)
