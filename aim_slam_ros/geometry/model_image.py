"""An image as VGGT's own preprocessing gives it to the network, and K on both sides of that."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from . import camera

_PATCH_PX = 14   # both sides of the network's image are multiples of it


@dataclass(frozen=True)
class ModelImage:
    """image: [H,W,3] uint8 RGB, contiguous. scale_x, scale_y: of the resize, which is anisotropic
    since each side is rounded to patches by itself. top_px: rows cut off above after the resize.
    """

    image: np.ndarray
    scale_x: float
    scale_y: float
    top_px: int

    def K_model(self, K_camera: Tensor) -> Tensor:
        """K [3,3] in pixels of the camera's image to K in pixels of this one."""
        K = camera.scaled(K_camera.double(), self.scale_x, self.scale_y)
        K[1, 2] -= self.top_px
        return K


def model_image(image: np.ndarray, width: int) -> ModelImage:
    """image: [H,W,3] uint8 RGB; resized to this width and, where it is higher than wide, cut to
    its middle.

    Bicubic and antialiased, as PIL does it (a grey level or two apart in a few pixels).
    """
    height = max(1, round(image.shape[0] * width / image.shape[1] / _PATCH_PX)) * _PATCH_PX
    # copied by torch: images of messages are read-only, which it does not know
    channels = torch.tensor(np.ascontiguousarray(image))[None].permute(0, 3, 1, 2)
    resized = F.interpolate(channels, (height, width), mode='bicubic', antialias=True)
    top = max(0, height - width) // 2
    cut = resized[0, :, top:top + width].permute(1, 2, 0).numpy()
    # A copy: a view would keep torch's memory, what was cut away included.
    return ModelImage(cut.copy(), width / image.shape[1], height / image.shape[0], top)
