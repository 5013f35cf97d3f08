"""What is computed once per image and kept with its keyframe, in bounded memory."""

from __future__ import annotations

from weakref import WeakValueDictionary

import torch
from torch import Tensor

from ...types import Frame
from .aggregator import Grid
from .network import Vggt
from .sizes import PATCH_PX


class FrameTokens:
    """One image's tokens: made when they are asked for, dropped when memory is wanted."""

    def __init__(self, uid: int, frame: Frame) -> None:
        self.uid = uid
        self.grid = Grid(frame.height // PATCH_PX, frame.width // PATCH_PX)
        self._frame = frame
        self._patches: Tensor | None = None
        self._begun: dict[bool, Tensor] = {}

    def patches(self, network: Vggt) -> Tensor:
        """[P,C] on the network's device."""
        if self._patches is None:
            self._patches = network.encode(_image(self._frame, network.device))[0]
        return self._patches

    def begun(self, network: Vggt, first: bool) -> Tensor:
        """[T,C] after the first frame block, as the window's first view or as another."""
        if first not in self._begun:
            self._begun[first] = network.begin(self.patches(network)[None], self.grid, first)[0]
        return self._begun[first]

    @property
    def empty(self) -> bool:
        return self._patches is None

    def drop(self) -> None:
        self._patches = None
        self._begun.clear()


class TokenCache:
    """Drops the tokens of the images that were not used for longest.

    It keeps no image alive: tokens whose keyframe is gone are gone.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._recent: WeakValueDictionary[int, FrameTokens] = WeakValueDictionary()

    def __len__(self) -> int:
        return len(self._recent)

    def used(self, tokens: FrameTokens) -> None:
        self._recent.pop(tokens.uid, None)
        self._recent[tokens.uid] = tokens
        surplus = len(self._recent) - self._limit
        for old in list(self._recent.values())[:max(0, surplus)]:
            self._forget(old)

    def clear(self) -> None:
        for tokens in list(self._recent.values()):
            self._forget(tokens)

    def _forget(self, tokens: FrameTokens) -> None:
        tokens.drop()
        self._recent.pop(tokens.uid, None)


def _image(frame: Frame, device: torch.device) -> Tensor:
    """[1,3,H,W] in 0..1; the bytes travel, not the floats."""
    image = torch.tensor(frame.image).to(device)
    return image.permute(2, 0, 1)[None].float() / 255.0
