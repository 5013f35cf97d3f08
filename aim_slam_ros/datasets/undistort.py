"""A sequence without its lens distortion."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np

from aim_slam_ros.datasets.base import Calibration, DatasetError, ImageError, Sequence


def undistorted(sequence: Sequence, source: str) -> Sequence:
    """The sequence with undistorted images and the same K; raises DatasetError."""
    if sequence.calibration is None:
        raise DatasetError(source, 'has no calibration that could undistort its images',
                           'add a camera.txt, or leave undistort off')
    if sequence.calibration.distortion is None:
        return sequence
    return UndistortedSequence(sequence, sequence.calibration)


class UndistortedSequence(Sequence):
    """Another sequence seen through an ideal pinhole camera with the same K."""

    def __init__(self, inner: Sequence, calibration: Calibration) -> None:
        super().__init__(inner.name, inner.stamps_ns,
                         dataclasses.replace(calibration, distortion=None), inner.groundtruth,
                         inner.dropped_stamps, inner.unreadable_lines)
        self._inner = inner
        self._lens = calibration
        self._maps: tuple[np.ndarray, np.ndarray] | None = None

    def image(self, index: int) -> np.ndarray:
        return self._remapped(self._inner.image(index), index, cv2.INTER_LINEAR)

    def depth(self, index: int) -> np.ndarray | None:
        depth = self._inner.depth(index)
        # Nearest: a mean of two depths across an edge is a point in the air.
        return None if depth is None else self._remapped(depth, index, cv2.INTER_NEAREST)

    def _remapped(self, image: np.ndarray, index: int, interpolation: int) -> np.ndarray:
        if self._maps is None:
            K, size = self._lens.K, image.shape[1::-1]
            self._maps = cv2.initUndistortRectifyMap(
                K, self._lens.distortion, None, K, size, cv2.CV_32FC1)
        if image.shape[:2] != self._maps[0].shape:
            raise ImageError(f'{self.name}[{index}]',
                             f'is {image.shape[1]}x{image.shape[0]} pixels, unlike the others')
        map_x, map_y = self._maps
        return cv2.remap(image, map_x, map_y, interpolation)
