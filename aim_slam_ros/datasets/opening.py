"""Which kind of dataset a path is."""

from __future__ import annotations

import logging
from pathlib import Path

from aim_slam_ros.datasets.bag_sequence import BagSequence
from aim_slam_ros.datasets.bag_topics import BagTopics, parsed_topics
from aim_slam_ros.datasets.bags import is_bag
from aim_slam_ros.datasets.base import DatasetError, Sequence
from aim_slam_ros.datasets.euroc import EurocSequence, find_cam0
from aim_slam_ros.datasets.folder import FolderSequence, list_images
from aim_slam_ros.datasets.images import SUFFIXES
from aim_slam_ros.datasets.rendered import PREFIX, load_rendered
from aim_slam_ros.datasets.tum import TumSequence
from aim_slam_ros.datasets.undistort import undistorted
from aim_slam_ros.datasets.video import VideoSequence

_log = logging.getLogger(__name__)


def load_sequence(source: str | Path, *, undistort: bool = False,
                  cache_dir: Path | None = None) -> Sequence:
    """Open a dataset.

    source: a TUM RGB-D folder, a EuRoC folder (the one that holds mav0, mav0 or cam0), a folder
    of images, a video, a bag (a rosbag2 folder, a single .mcap or .db3, a ROS 1 .bag), with
    ``?topic=TOPIC`` where it holds several image topics (bag_topics.py tells more), or
    ``rendered:room`` or ``rendered:corridor``, with ``?seed=N`` if wanted.
    undistort: deliver images without lens distortion; needs a calibration.
    cache_dir: where rendered scenes are kept; by default the user's cache.
    Raises DatasetError, naming what was looked for, where the source is nothing of these.
    """
    if str(source).startswith(PREFIX):
        sequence = load_rendered(str(source), cache_dir)
    else:
        sequence = _open(str(source))
        _say_what_is_left_out(sequence)
    return undistorted(sequence, str(source)) if undistort else sequence


def _say_what_is_left_out(sequence: Sequence) -> None:
    for count, why in ((sequence.dropped_stamps, 'their stamp is not newer than that of one '
                        'before them'), (sequence.unreadable_lines, 'their entry is damaged')):
        if count:
            _log.warning('%s: %d of the listed images are left out: %s', sequence.name, count, why)


def _open(source: str) -> Sequence:
    path, topics = Path(source).expanduser(), BagTopics()
    if not path.exists() and '?' in source:
        name, _, query = source.rpartition('?')
        path, topics = Path(name).expanduser(), parsed_topics(source, query)
    if not path.exists():
        raise DatasetError(path, 'does not exist', 'check the path')
    if is_bag(path) and not (path.is_dir() and _is_other(path)):
        return BagSequence(path, topics)
    if topics != BagTopics():
        raise DatasetError(path, 'is no bag', 'leave "?..." away, which chooses topics of a bag')
    return _open_other(path)


def _is_other(folder: Path) -> bool:
    """A dataset that a bag or a metadata.yaml happens to lie in."""
    return (folder / 'rgb.txt').exists() or bool(find_cam0(folder) or list_images(folder))


def _open_other(path: Path) -> Sequence:
    if path.suffix.lower() in SUFFIXES and not path.is_dir():
        raise DatasetError(path, 'is a single image', 'name the folder that holds the images')
    if not path.is_dir():
        return VideoSequence(path)
    if (path / 'rgb.txt').exists():
        return TumSequence(path)
    cam0 = find_cam0(path)
    if cam0 is not None:
        return EurocSequence(cam0)
    if list_images(path):
        return FolderSequence(path)
    raise DatasetError(path, 'is no dataset; looked for rgb.txt (TUM RGB-D), mav0/cam0/data.csv '
                       'and data/ (EuRoC), metadata.yaml (rosbag2) and images',
                       'name the folder that holds one of these' + _nearby(path))


def _nearby(path: Path) -> str:
    """The subfolders that would have worked, for the message."""
    found = [child.name for child in sorted(path.iterdir()) if child.is_dir()
             and (_is_other(child) or is_bag(child))]
    return f' (perhaps its {" or ".join(found[:3])})' if found else ''
