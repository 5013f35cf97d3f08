"""A folder of images, in the natural order of their names."""

from __future__ import annotations

import re
from decimal import Decimal
from pathlib import Path

import numpy as np

from aim_slam_ros.datasets.base import DatasetError, Sequence
from aim_slam_ros.datasets.calibration import read_camera_file
from aim_slam_ros.datasets.images import SUFFIXES, check_size, read_image
from aim_slam_ros.datasets.text import read_tum_trajectory

# The rate assumed for images whose names tell no time.
FALLBACK_RATE_HZ = 30.0
_NUMBER = re.compile(r'\d+(?:\.\d+)?')
# A number this large is a Unix time in ns, us or ms; a smaller one is a frame number, or with
# decimals a time in seconds.
_EPOCH_UNITS_NS = ((10**17, 1), (10**14, 1_000), (10**11, 1_000_000))
_SECONDS = (0, 1_000_000_000)


def list_images(folder: Path) -> list[Path]:
    """The images of a folder in natural order; hidden files are left out."""
    found = [path for path in folder.iterdir()
             if path.suffix.lower() in SUFFIXES and not path.name.startswith('.')]
    return sorted(found, key=_natural_key)


class FolderSequence(Sequence):
    """Images named by time or number; camera.txt and groundtruth.txt beside them are used."""

    def __init__(self, folder: Path) -> None:
        """Raises DatasetError."""
        files = list_images(folder)
        if not files:
            raise DatasetError(
                folder, f'holds no image; looked for {", ".join(sorted(SUFFIXES))}',
                'name the folder that holds the images')
        camera = read_camera_file(folder / 'camera.txt')
        truth = folder / 'groundtruth.txt'
        stamps_ns = _stamps_ns([path.stem for path in files])
        # Two names of one time (7.png, 07.png) cannot both be kept.
        kept = np.flatnonzero(np.diff(stamps_ns, prepend=stamps_ns[0] - 1) > 0)
        super().__init__(folder.resolve().name, stamps_ns[kept],
                         None if camera is None else camera.calibration,
                         read_tum_trajectory(truth) if truth.exists() else None,
                         len(files) - len(kept))
        self._files = [files[i] for i in kept]
        check_size(self._files[0], self.calibration)

    def image(self, index: int) -> np.ndarray:
        return read_image(self._files[index])


def _natural_key(path: Path) -> tuple[tuple[int, Decimal, str], ...]:
    """Numbers compare as numbers and before text, so that 9.png comes before 10.png."""
    parts = re.split(f'({_NUMBER.pattern})', path.stem)
    key = [(0, Decimal(part), '') if i % 2 else (1, Decimal(0), part)
           for i, part in enumerate(parts) if part]
    return (*key, (1, Decimal(0), path.name))


def _stamps_ns(stems: list[str]) -> np.ndarray:
    """[N] int64: times where all names are times, else the order at FALLBACK_RATE_HZ."""
    if all(_NUMBER.fullmatch(stem) for stem in stems):
        numbers = [Decimal(stem) for stem in stems]
        units = (*_EPOCH_UNITS_NS, _SECONDS) if any('.' in stem for stem in stems) \
            else _EPOCH_UNITS_NS
        for least, unit_ns in units:
            if min(numbers) >= least and max(numbers) * unit_ns < 2**63:
                return np.array([round(number * unit_ns) for number in numbers], np.int64)
    return np.round(np.arange(len(stems)) * (1e9 / FALLBACK_RATE_HZ)).astype(np.int64)
