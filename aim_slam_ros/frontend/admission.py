"""Which images enter, and in what shape."""

from __future__ import annotations

import numpy as np
import torch

from ..config import CameraConfig
from ..geometry.model_image import model_image
from ..types import Frame


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
        resized = model_image(image, self._config.width)
        # A camera_info of zeros says that nobody has calibrated the camera.
        calibrated = self._config.use_calibration and K is not None \
            and bool(np.isfinite(K).all()) and K[0, 0] > 0 and K[1, 1] > 0
        K_model = resized.K_model(torch.as_tensor(K)) if calibrated else None
        return Frame(stamp_ns, resized.image, K_model, resized.scale_y / resized.scale_x)

    def _refusal(self, stamp_ns: int, image: np.ndarray) -> str:
        if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
            return f'an image must be [H,W,3] uint8 RGB, not {image.shape} {image.dtype}'
        height, width = image.shape[:2]
        if min(height, width) < self._config.min_side:
            return f'the image is too small: {width}x{height}'
        if self._size is not None and self._size != (height, width):
            return (f'the image is {width}x{height}, '
                    f'but the map was begun with {self._size[1]}x{self._size[0]}: reset to begin '
                    'another')
        if self._stamp_ns is not None and stamp_ns <= self._stamp_ns:
            return f'its stamp {stamp_ns} ns is not newer than the last, {self._stamp_ns} ns'
        # Every fourth pixel tells a black or constant image as well as all of them do.
        contrast = float(image[::4, ::4].std())
        if contrast < self._config.min_contrast:
            return f'the image is black or nearly constant (standard deviation {contrast:.1f})'
        return ''
