"""Depth and pose of a recording's images, for the simulated model."""

from __future__ import annotations

import logging
from typing import Iterable

import numpy as np
import torch
from torch import Tensor

from aim_slam_ros.datasets.base import DatasetError, ImageError, Sequence
from aim_slam_ros.geometry import camera, sim3
from aim_slam_ros.models.truth import TrueView
from aim_slam_ros.types import StampedPoses

_log = logging.getLogger(__name__)
_PROPORTION = 0.02      # width to height, how far that of depth may be from that of its image
_MAX_GAP_NS = 100_000_000   # between two true poses, for one between them to be believed


class RecordedTruth:
    """A TruthProvider that reads from a dataset."""

    def __init__(self, sequence: Sequence) -> None:
        self._sequence = sequence
        self._image_size = (0, 0)       # width and height, once they are known
        self._said = False

    def at(self, stamp_ns: int) -> TrueView | None:
        """The truth about the image with exactly this stamp."""
        index = int(np.searchsorted(self._sequence.stamps_ns, stamp_ns))
        if index == len(self._sequence) or self._sequence.stamps_ns[index] != stamp_ns:
            return None
        truth, K = self._sequence.groundtruth, self._sequence.K
        T_world_cam = None if truth is None else pose_at(truth, stamp_ns)
        depth = self._depth(index)
        if depth is None or T_world_cam is None or K is None:
            return None
        return TrueView(depth, self._K_of_depth(torch.from_numpy(K).double(), depth), T_world_cam)

    def with_depth(self, indices: Iterable[int]) -> list[int]:
        """Those of the images that have depth and, where the dataset has ground truth, a pose."""
        truth, stamps = self._sequence.groundtruth, self._sequence.stamps_ns
        return [i for i in indices
                if (truth is None or pose_at(truth, int(stamps[i])) is not None)
                and self._depth(i) is not None]

    def require(self, indices: Iterable[int]) -> None:
        """Raises DatasetError unless all is known of each of these images."""
        name, indices = self._sequence.name, list(indices)
        for lacks, what in ((self._sequence.K is None, 'calibration'),
                            (self._sequence.groundtruth is None, 'ground truth')):
            if lacks:
                raise DatasetError(name, f'has no {what}, which the simulated model needs',
                                   'take another dataset or another model')
        missing = len(indices) - len(self.with_depth(indices))
        if missing:
            raise DatasetError(
                name, f'{missing} of the {len(indices)} images have no depth or no true pose, '
                'which the simulated model needs',
                'take only images that have them (--with-depth) or another model')

    def _depth(self, index: int) -> np.ndarray | None:
        """[h,w] float32 metres, 0 where unknown; None where nothing is known."""
        try:
            depth = self._sequence.depth(index)
        except ImageError:
            return None
        if depth is None or not self._belongs(depth, index):
            return None
        known = np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0.0))
        return known if known.any() else None

    def _belongs(self, depth: np.ndarray, index: int) -> bool:
        """Whether it can be the image's, perhaps with fewer pixels: of the same proportions."""
        (height, width), (image_width, image_height) = depth.shape, self._size_of(index)
        if not image_width:
            return True
        ratio = width * image_height / (height * image_width)
        if abs(ratio - 1.0) < _PROPORTION:
            return True
        if not self._said:
            self._said = True
            _log.warning(
                '%s: depth of %dx%d pixels cannot be that of images of %dx%d; register it to them',
                self._sequence.name, width, height, image_width, image_height)
        return False

    def _K_of_depth(self, K: Tensor, depth: np.ndarray) -> Tensor:
        (height, width), (image_width, image_height) = depth.shape, self._image_size
        if not image_width or (width, height) == self._image_size:
            return K
        return camera.scaled(K, width / image_width, height / image_height)

    def _size_of(self, index: int) -> tuple[int, int]:
        """Of all images; an unreadable one does not tell it."""
        if not self._image_size[0]:
            calibration = self._sequence.calibration
            if calibration is not None and calibration.width:
                self._image_size = calibration.width, calibration.height
            else:
                try:
                    height, width = self._sequence.image(index).shape[:2]
                except ImageError:
                    return self._image_size
                self._image_size = width, height
        return self._image_size


def pose_at(poses: StampedPoses, stamp_ns: int) -> Tensor | None:
    """T_world_cam [4,4] at a time, between its two neighbours; None where they are too far."""
    after = int(np.searchsorted(poses.stamps_ns, stamp_ns))
    if after < len(poses) and poses.stamps_ns[after] == stamp_ns:
        return torch.from_numpy(poses.T_world_cam[after])
    if after in (0, len(poses)):
        return None
    start_ns, end_ns = (int(poses.stamps_ns[i]) for i in (after - 1, after))
    if end_ns - start_ns > _MAX_GAP_NS:
        return None
    T_start, T_end = (torch.from_numpy(poses.T_world_cam[i]) for i in (after - 1, after))
    share = (stamp_ns - start_ns) / (end_ns - start_ns)
    return T_start @ sim3.exp(share * sim3.log(sim3.inverse(T_start) @ T_end))
