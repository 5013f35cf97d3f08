"""Which images enter, and in what shape."""

from __future__ import annotations

import cv2
import numpy as np
import torch

from ..config import CameraConfig
from ..geometry import camera
from ..types import Frame

_PATCH = 14   # the model's patch size: both sides of its image are multiples of it


class Admission:
    """Checks an image and resizes it as VGGT's preprocessing does.

    An image that cannot be used is answered with the reason, for a person, not with an exception.
    """

    def __init__(self, config: CameraConfig) -> None:
        self._config = config
        self._size: tuple[int, int] | None = None
        self._stamp_ns: int | None = None

    def admit(self, stamp_ns: int, image: np.ndarray, K: np.ndarray | None) -> Frame | str:
        """The frame, or why the image is skipped. image: [H,W,3] uint8 RGB; K: [3,3] or None."""
        reason = self._refusal(stamp_ns, image)
        if reason:
            return reason
        self._size, self._stamp_ns = image.shape[:2], stamp_ns
        height, width = image.shape[:2]
        model_width = self._config.width
        model_height = max(1, round(height * model_width / width / _PATCH)) * _PATCH
        shrink = model_width < width
        resized = cv2.resize(image, (model_width, model_height),
                             interpolation=cv2.INTER_AREA if shrink else cv2.INTER_CUBIC)
        scale_x, scale_y = model_width / width, model_height / height
        # A camera_info of zeros says that nobody has calibrated the camera.
        calibrated = self._config.use_calibration and K is not None \
            and bool(np.isfinite(K).all()) and K[0, 0] > 0 and K[1, 1] > 0
        K_model = camera.scaled(torch.as_tensor(K, dtype=torch.float64), scale_x, scale_y) \
            if calibrated else None
        return Frame(stamp_ns, resized, K_model, scale_y / scale_x)

    def _refusal(self, stamp_ns: int, image: np.ndarray) -> str:
        if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
            return f'an image must be [H,W,3] uint8 RGB, not {image.shape} {image.dtype}'
        height, width = image.shape[:2]
        if min(height, width) < self._config.min_side:
            return f'the image is too small: {width}x{height}'
        if self._size is not None and self._size != (height, width):
            return (f'the image is {width}x{height}, '
                    f'but the map was begun with {self._size[1]}x{self._size[0]}')
        if self._stamp_ns is not None and stamp_ns <= self._stamp_ns:
            return f'its stamp {stamp_ns} ns is not newer than the last, {self._stamp_ns} ns'
        # Every fourth pixel tells a black or constant image as well as all of them do.
        contrast = float(image[::4, ::4].std())
        if contrast < self._config.min_contrast:
            return f'the image is black or nearly constant (standard deviation {contrast:.1f})'
        return ''
