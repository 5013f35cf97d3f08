"""A video file, through OpenCV."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from aim_slam_ros.datasets.base import DatasetError, ImageError, Sequence
from aim_slam_ros.datasets.folder import FALLBACK_RATE_HZ


class VideoSequence(Sequence):
    """Frames at the file's constant rate, the first at time 0. Fastest when read in order."""

    def __init__(self, path: Path) -> None:
        """Raises DatasetError."""
        self._path = path
        self._capture = cv2.VideoCapture(str(path))
        count = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        if count <= 0:      # a stream without a header: 0, or something absurd
            count = self._counted()
        if not self._capture.isOpened() or count <= 0:
            raise DatasetError(path, 'is not a video that OpenCV can open',
                               'name a video file, a folder of images, a TUM RGB-D or a EuRoC '
                               'folder, or convert the video to H.264')
        rate_hz = self._capture.get(cv2.CAP_PROP_FPS)
        rate_hz = rate_hz if np.isfinite(rate_hz) and rate_hz > 0 else FALLBACK_RATE_HZ
        super().__init__(path.stem, np.round(np.arange(count) * (1e9 / rate_hz)))
        self._next = 0
        self._last: np.ndarray | None = None

    def image(self, index: int) -> np.ndarray:
        if not -len(self) <= index < len(self):
            raise IndexError(f'{self._path}: frame {index} of {len(self)}')
        index %= len(self)
        if self._last is None or index != self._next - 1:
            self._last = self._decoded(index)
        return self._last.copy()

    def _decoded(self, index: int) -> np.ndarray:
        if index < self._next:
            # Seeking lands on key frames only in some containers; from the start it is exact.
            self._capture.open(str(self._path))
            self._next = 0
        self._last = None
        while self._next < index and self._capture.grab():
            self._next += 1
        read, image = self._capture.read() if self._next == index else (False, None)
        if not read or image is None:
            raise ImageError(self._path, f'frame {index} cannot be decoded')
        self._next = index + 1
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)

    def _counted(self) -> int:
        """For containers whose header does not tell the number of frames."""
        count = 0
        while self._capture.grab():
            count += 1
        self._capture.open(str(self._path))
        return count
