"""Bags made from datasets, kept in the user's cache so that the next demo begins at once."""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
from pathlib import Path
from typing import Iterator, Sequence as Indices

import numpy as np

from aim_slam_ros.cli.counting import counter
from aim_slam_ros.datasets.bag_writing import write_bag
from aim_slam_ros.datasets.bags import is_bag
from aim_slam_ros.datasets.base import ImageError, Sequence
from aim_slam_ros.datasets.rendered import user_cache

# Part of every name: count up when bags are written differently.
_VERSION = 1
_KEPT = 4       # a minute of video is more than a gigabyte
_NAME_LENGTH = 40


def cached_bag(source: str, sequence: Sequence, indices: Indices[int]) -> Path:
    """The bag of these images, written first where it is not there.

    source: what ``sequence`` was opened from. A dataset whose files changed in number, size or
    time gives another bag. Of all bags the last few used are kept. Raises DatasetError.
    """
    folder = user_cache() / 'bags'
    bag = folder / f'{_safe(sequence.name)}-{_fingerprint(source, sequence, indices)}'
    if not is_bag(bag):
        print(f'writing {len(indices)} images as a bag, once', file=sys.stderr)
        with counter(len(indices), 'image') as progress:
            written = write_bag(sequence, indices, bag, progress=progress)
        for error in written.unreadable:
            print(f'skipped {error}')
    os.utime(bag)
    _forget_all_but_newest(folder)
    return bag


def _fingerprint(source: str, sequence: Sequence, indices: Indices[int]) -> str:
    """Names the content: the stamps, the selection, an image and every file of the source."""
    digest = hashlib.sha256(repr((_VERSION, source, list(indices), sequence.K)).encode())
    digest.update(np.ascontiguousarray(sequence.stamps_ns).tobytes())
    try:    # a rendered scene has no files that the source names
        digest.update(sequence.image(indices[0]).tobytes())
    except ImageError:
        pass
    path = Path(source).expanduser()
    for file in _files(path) if path.exists() else ():
        state = file.stat()
        digest.update(repr((str(file), state.st_size, state.st_mtime_ns)).encode())
    return digest.hexdigest()[:16]


def _files(path: Path) -> Iterator[Path]:
    """The file, or everything below the folder, in a fixed order."""
    if not path.is_dir():
        yield path.resolve()
        return
    for folder, subfolders, names in os.walk(path.resolve()):
        subfolders.sort()
        yield from (Path(folder, name) for name in sorted(names))


def _safe(name: str) -> str:
    return ''.join(c if c.isalnum() else '_' for c in name)[:_NAME_LENGTH]


def _forget_all_but_newest(folder: Path) -> None:
    """By the time of last use. One that is being played stays readable to its reader."""
    bags = sorted((path for path in folder.iterdir() if is_bag(path)),
                  key=lambda path: path.stat().st_mtime, reverse=True)
    for old in bags[_KEPT:]:
        shutil.rmtree(old, ignore_errors=True)
