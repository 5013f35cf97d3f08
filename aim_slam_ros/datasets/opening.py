"""Which kind of dataset a path is."""

from __future__ import annotations

from pathlib import Path

from aim_slam_ros.datasets.base import DatasetError, Sequence
from aim_slam_ros.datasets.euroc import EurocSequence, find_cam0
from aim_slam_ros.datasets.folder import FolderSequence, list_images
from aim_slam_ros.datasets.images import SUFFIXES
from aim_slam_ros.datasets.rendered import PREFIX, load_rendered
from aim_slam_ros.datasets.tum import TumSequence
from aim_slam_ros.datasets.undistort import undistorted
from aim_slam_ros.datasets.video import VideoSequence


def load_sequence(source: str | Path, *, undistort: bool = False,
                  cache_dir: Path | None = None) -> Sequence:
    """Open a dataset.

    source: a TUM RGB-D folder, a EuRoC folder (the one that holds mav0, mav0 or cam0), a folder
    of images, a video, or ``rendered:room`` or ``rendered:corridor``, with ``?seed=N`` if wanted.
    undistort: deliver images without lens distortion; needs a calibration.
    cache_dir: where rendered scenes are kept; by default the user's cache.
    Raises DatasetError, naming what was looked for, where the source is nothing of these.
    """
    if str(source).startswith(PREFIX):
        sequence = load_rendered(str(source), cache_dir)
    else:
        sequence = _open(Path(source).expanduser())
    return undistorted(sequence, str(source)) if undistort else sequence


def _open(path: Path) -> Sequence:
    if not path.exists():
        raise DatasetError(path, 'does not exist', 'check the path')
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
                       'and data/ (EuRoC) and images', 'name the folder that holds one of these'
                       + _nearby(path))


def _nearby(path: Path) -> str:
    """The subfolders that would have worked, for the message."""
    found = [child.name for child in sorted(path.iterdir()) if child.is_dir()
             and ((child / 'rgb.txt').exists() or find_cam0(child) or list_images(child))]
    return f' (perhaps its {" or ".join(found[:3])})' if found else ''
