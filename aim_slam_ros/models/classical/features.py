"""What the classical model keeps of one image: keypoints, a global descriptor, a small image."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import torch
from torch import Tensor

from ...types import Frame

_HASH_BITS = 6


@dataclass(frozen=True)
class ClassicalFeatures:
    """uid: unique in this process, the key of every cache.

    uv: [M,2] float32, pixels of the frame. sift: [M,128] float32 RootSIFT, unit length.
    small: [H/4,W/4] uint8, normalised to its local mean and contrast.
    """

    uid: int
    uv: np.ndarray
    sift: np.ndarray
    small: np.ndarray


def detect(frame: Frame, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Keypoints [M,2] float32 in pixels of the frame and RootSIFT [M,128], at half resolution."""
    half = cv2.resize(frame.grey, (frame.width // 2, frame.height // 2),
                      interpolation=cv2.INTER_AREA)
    # Without the precise upscale every keypoint is a quarter of a pixel off, to the lower right.
    detector = cv2.SIFT_create(count, contrastThreshold=0.02, enable_precise_upscale=True)
    keypoints, sift = detector.detectAndCompute(half, None)
    if sift is None:
        return np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32)
    uv = cv2.KeyPoint_convert(keypoints)
    scale = np.array([frame.width / half.shape[1], frame.height / half.shape[0]], np.float32)
    root = np.sqrt(sift / np.maximum(sift.sum(1, keepdims=True), 1e-6))
    return ((uv + 0.5) * scale - 0.5).astype(np.float32), root.astype(np.float32)


def contrast_normalised(frame: Frame) -> np.ndarray:
    """[H/4,W/4] uint8: (image - local mean) / local deviation around 128; 0 is kept free."""
    grey = cv2.resize(frame.grey, (frame.width // 4, frame.height // 4),
                      interpolation=cv2.INTER_AREA).astype(np.float32)
    mean = cv2.blur(grey, (9, 9))
    deviation = np.sqrt(np.maximum(cv2.blur(grey * grey, (9, 9)) - mean * mean, 0.0))
    return np.clip(128.0 + 48.0 * (grey - mean) / (deviation + 4.0), 1, 255).astype(np.uint8)


@lru_cache(maxsize=1)
def _hash_planes() -> np.ndarray:
    return np.random.default_rng(7).standard_normal((128, _HASH_BITS)).astype(np.float32)


def global_descriptor(sift: np.ndarray) -> Tensor:
    """[2^6 * 128] float32, unit length: RootSIFT residuals pooled per cell of a random hashing.

    A VLAD without a trained vocabulary. The cells are made by the signs of random projections.
    """
    cells = 2 ** _HASH_BITS
    pooled = np.zeros((cells, 128), np.float32)
    if len(sift):
        centred = sift - sift.mean(0)
        bits = centred @ _hash_planes() > 0
        np.add.at(pooled, bits @ (1 << np.arange(_HASH_BITS)), centred)
        pooled /= np.maximum(np.linalg.norm(pooled, axis=1, keepdims=True), 1e-6)
    else:
        pooled[0, 0] = 1.0
    flat = torch.from_numpy(pooled.reshape(-1))
    return flat / flat.norm()
