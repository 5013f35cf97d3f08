"""The TUM RGB-D form: rgb.txt, and beside it groundtruth.txt, camera.txt and depth, if any."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from aim_slam_ros.datasets.base import Sequence
from aim_slam_ros.datasets.calibration import TUM_DEPTH_SCALE, read_camera_file
from aim_slam_ros.datasets.images import check_size, read_depth, read_image
from aim_slam_ros.datasets.text import (
    StampedList, lines, read_stamped_list, read_tum_trajectory)

# Colour and depth of a Kinect run unsynchronised at 30 Hz; TUM's own tools pair within 20 ms.
_MAX_DEPTH_GAP_NS = 20_000_000


class TumSequence(Sequence):
    """A folder with rgb.txt."""

    def __init__(self, folder: Path) -> None:
        """Raises DatasetError."""
        listed = read_stamped_list(folder / 'rgb.txt', 'timestamp filename', 2)
        camera = read_camera_file(folder / 'camera.txt')
        truth = folder / 'groundtruth.txt'
        super().__init__(folder.resolve().name, listed.stamps_ns,
                         None if camera is None else camera.calibration,
                         read_tum_trajectory(truth) if truth.exists() else None,
                         listed.dropped_stamps, listed.unreadable_lines)
        self._folder = folder
        self._files = [value[0] for value in listed.values]
        self._depth_files = _depth_files(folder, listed)
        self._depth_scale = TUM_DEPTH_SCALE if camera is None else camera.depth_scale
        check_size(folder / self._files[0], self.calibration)

    def image(self, index: int) -> np.ndarray:
        return read_image(self._folder / self._files[index])

    def depth(self, index: int) -> np.ndarray | None:
        file = self._depth_files.get(self._files[index])
        return None if file is None else read_depth(self._folder / file, self._depth_scale)


def _depth_files(folder: Path, images: StampedList) -> dict[str, str]:
    """Image file to depth file: from associations.txt, else by time from depth.txt."""
    if (folder / 'associations.txt').exists():
        return _associated(folder / 'associations.txt', {value[0] for value in images.values})
    if (folder / 'depth.txt').exists():
        return _nearest(images, read_stamped_list(folder / 'depth.txt', 'timestamp filename', 2))
    return {}


def _associated(path: Path, image_files: set[str]) -> dict[str, str]:
    """Pairs of associations.txt, whichever of the two is written first (both are in use)."""
    pairs = {}
    for line in lines(path):
        if len(line.fields) >= 4:
            first, second = line.fields[1], line.fields[3]
            if first in image_files:
                pairs[first] = second
            elif second in image_files:
                pairs[second] = first
    return pairs


def _nearest(images: StampedList, depths: StampedList) -> dict[str, str]:
    """The depth image nearest in time to each image, where it is near enough."""
    after = np.searchsorted(depths.stamps_ns, images.stamps_ns).clip(1, None)
    after = np.minimum(after, len(depths.stamps_ns) - 1)
    candidates = np.stack([np.maximum(after - 1, 0), after])
    gaps = np.abs(depths.stamps_ns[candidates] - images.stamps_ns)
    best = np.take_along_axis(candidates, gaps.argmin(0)[None], 0)[0]
    near = gaps.min(0) <= _MAX_DEPTH_GAP_NS
    return {images.values[i][0]: depths.values[best[i]][0] for i in np.flatnonzero(near)}
