"""What every dataset looks like to its users."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from aim_slam_ros.types import StampedPoses


class DatasetError(ValueError):
    """A path that is not a dataset, or a dataset file that cannot be understood."""

    def __init__(self, path: str | Path, problem: str, remedy: str) -> None:
        super().__init__(f'{path}: {problem}; {remedy}')
        self.path = Path(path)


class ImageError(OSError):
    """One image that is missing, empty or damaged: skip it and count it."""

    def __init__(self, path: str | Path, reason: str) -> None:
        super().__init__(f'{path}: {reason}')
        self.path = Path(path)
        self.reason = reason


@dataclass(frozen=True)
class Calibration:
    """A pinhole camera.

    K: [3,3] float64, pixels. distortion: OpenCV k1 k2 p1 p2 [k3 ...], None without distortion.
    width, height: pixels of the images it holds for; 0 where unknown.
    """

    K: np.ndarray
    distortion: np.ndarray | None = None
    width: int = 0
    height: int = 0


class Sequence(ABC):
    """Images in time order, with what is known about the camera and its path.

    stamps_ns: [N] int64, strictly increasing. Left out of the list of images: ``dropped_stamps``
    that were not newer than one before them, ``unreadable_lines`` that were malformed.
    groundtruth: camera-to-world, metres, or None. Its stamps are its own, not the images'.
    """

    def __init__(self, name: str, stamps_ns: np.ndarray, calibration: Calibration | None = None,
                 groundtruth: StampedPoses | None = None, dropped_stamps: int = 0,
                 unreadable_lines: int = 0) -> None:
        self.name = name
        self.stamps_ns = np.asarray(stamps_ns, np.int64)
        self.calibration = calibration
        self.groundtruth = groundtruth
        self.dropped_stamps = dropped_stamps
        self.unreadable_lines = unreadable_lines

    @property
    def K(self) -> np.ndarray | None:
        """[3,3] float64, pixels of the images as delivered; None where uncalibrated."""
        return None if self.calibration is None else self.calibration.K

    @property
    def distortion(self) -> np.ndarray | None:
        """OpenCV k1 k2 p1 p2 [k3 ...] of the images as delivered; None without distortion."""
        return None if self.calibration is None else self.calibration.distortion

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @abstractmethod
    def image(self, index: int) -> np.ndarray:
        """[H,W,3] uint8 RGB, contiguous; raises ImageError."""

    def depth(self, index: int) -> np.ndarray | None:
        """[H,W] float32, metres along the optical axis, 0 where unknown; None without depth.

        Raises ImageError for a depth image that is listed and cannot be read.
        """
        return None
