"""The truth about an image, brought to the model's image."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from torch import Tensor

from ...geometry.model_image import model_image
from ...types import Frame
from ..classical.sweep import fill
from ..truth import TrueView


@dataclass(frozen=True)
class SeenView:
    """The truth in the model's image, with holes filled and edges smeared.

    log_depth: [H,W] float32, natural logarithm of metres. known: [H,W] bool, not a hole.
    smear: [H,W] float32, log_depth less its true value; 0 in holes.
    median_depth: of the known pixels, metres. K: pixels of the model's image.
    """

    log_depth: np.ndarray
    known: np.ndarray
    smear: np.ndarray
    median_depth: float
    K: Tensor
    T_world_cam: Tensor


def seen_view(truth: TrueView, frame: Frame, smear_px: float) -> SeenView:
    """smear_px: so many pixels lie between the two sides of an edge."""
    # The depth goes through the resize of its image: its grey values do not matter here.
    resize = model_image(np.zeros((*truth.depth.shape, 1), np.uint8), frame.width)
    rows, columns = (
        np.rint((np.arange(size) + first + 0.5) / scale - 0.5).astype(np.int64).clip(0, last - 1)
        for size, first, scale, last in (
            (frame.height, resize.top_px, resize.scale_y, truth.depth.shape[0]),
            (frame.width, 0, resize.scale_x, truth.depth.shape[1])))
    depth = truth.depth[rows[:, None], columns]     # nearest: a mean across an edge is in the air
    known = depth > 0
    rho = np.where(known, 1.0 / np.where(known, depth, 1.0), 0.0).astype(np.float32)
    filled = 1.0 / np.maximum(fill(rho, known.astype(np.float32)), 1e-4)
    log_depth = np.log(_smeared(filled, smear_px))
    return SeenView(log_depth, known, np.where(known, log_depth - np.log(filled), 0.0),
                    float(np.median(depth[known])), resize.K_model(truth.K), truth.T_world_cam)


def _smeared(depth: np.ndarray, smear_px: float) -> np.ndarray:
    """A mean over a square of side 1 + smear_px, with a part of its outermost pixels."""
    reach = int(np.ceil(smear_px / 2.0))
    kernel = (0.5 * (smear_px + 2.0) - np.abs(np.arange(-reach, reach + 1))).clip(0.0, 1.0)
    kernel /= kernel.sum()
    return cv2.sepFilter2D(depth, -1, kernel, kernel, borderType=cv2.BORDER_REPLICATE)
