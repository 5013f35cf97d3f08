"""Writing a sequence as a rosbag2, without ROS."""

from __future__ import annotations

import sqlite3
import tempfile
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Callable, Sequence as Indices

import numpy as np
from rosbags.interfaces import Connection
from rosbags.rosbag2 import StoragePlugin, Writer

from aim_slam_ros.datasets import bag_messages
from aim_slam_ros.datasets.bag_topics import camera_info_beside
from aim_slam_ros.datasets.bags import STORE
from aim_slam_ros.datasets.base import Calibration, DatasetError, ImageError, Sequence

STORAGES = {'mcap': StoragePlugin.MCAP, 'sqlite3': StoragePlugin.SQLITE3}
GROUNDTRUTH_TOPIC = '/groundtruth'
_SECOND_NS = 1_000_000_000
# Header stamps count seconds in an int32.
_END_OF_TIME_NS = 2**31 * _SECOND_NS


@dataclass(frozen=True)
class BagForm:
    """How a bag is written.

    storage: a name of STORAGES. image_topic: absolute; compressed images stand below it and
    camera_info beside it.
    """

    storage: str = 'mcap'
    image_topic: str = '/image'
    compressed: bool = False


@dataclass(frozen=True)
class WrittenBag:
    """unreadable: images left out. shift_ns: added to every stamp, since in ROS 0 is no time."""

    images: int
    camera_infos: int
    poses: int
    unreadable: tuple[ImageError, ...]
    shift_ns: int


def write_bag(sequence: Sequence, indices: Indices[int], out: Path, form: BagForm = BagForm(), *,
              progress: Callable[[], object] = lambda: None) -> WrittenBag:
    """The images of these indices, in time order, with the ground truth within a second of them.

    out: a folder that is not there yet, or one that is replaced when the bag is whole; until then
    nobody sees it. progress: called after each image.
    Raises DatasetError where it cannot be written or no image is readable.
    """
    out = out.resolve()
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix='.writing-', dir=out.parent) as aside:
            made = Path(aside) / out.name
            written = _written(sequence, indices, made, form, progress)
            if out.exists():
                out.rename(Path(aside) / 'replaced')
            made.rename(out)
    except (OSError, sqlite3.Error) as error:
        reason = getattr(error, 'strerror', None) or error
        raise DatasetError(out, f'cannot be written ({reason})', 'name another folder, or free '
                           'space') from error
    return written


def _written(sequence: Sequence, indices: Indices[int], folder: Path, form: BagForm,
             progress: Callable[[], object]) -> WrittenBag:
    shift_ns = _shift_ns(sequence, indices)
    poses = _poses_near(sequence, indices, shift_ns)
    unreadable = []
    with Writer(folder, version=9, storage_plugin=STORAGES[form.storage]) as writer:
        recorder = _Recorder(writer, sequence.calibration, form)
        for index in indices:
            stamp_ns = int(sequence.stamps_ns[index]) + shift_ns
            while poses and poses[0][0] <= stamp_ns:
                recorder.pose(*poses.popleft())
            try:
                recorder.image(stamp_ns, sequence.image(index))
            except ImageError as error:
                unreadable.append(error)
            progress()
        for pose in poses:
            recorder.pose(*pose)
        if len(unreadable) == len(indices):
            raise DatasetError(sequence.name, f'has no readable image ({unreadable[0]})',
                               'restore its images')
    return WrittenBag(len(indices) - len(unreadable), recorder.camera_infos, recorder.poses,
                      tuple(unreadable), shift_ns)


class _Recorder:
    """Writes messages with their stamps as log times; every topic begins with its first one."""

    def __init__(self, writer: Writer, calibration: Calibration | None, form: BagForm) -> None:
        self._writer = writer
        self._calibration = calibration
        self._form = form
        self._connections: dict[str, Connection] = {}
        self.camera_infos = self.poses = 0

    def image(self, stamp_ns: int, rgb: np.ndarray) -> None:
        """[H,W,3] uint8, after its camera_info: who gets both can use them at once."""
        topic = self._form.image_topic
        if self._calibration is not None:
            height, width = rgb.shape[:2]
            self._write(camera_info_beside(topic), stamp_ns,
                        bag_messages.camera_info(self._calibration, width, height, stamp_ns))
            self.camera_infos += 1
        if self._form.compressed:
            self._write(f'{topic}/compressed', stamp_ns, bag_messages.compressed(rgb, stamp_ns))
        else:
            self._write(topic, stamp_ns, bag_messages.image(rgb, stamp_ns))

    def pose(self, stamp_ns: int, T_world_cam: np.ndarray) -> None:
        """[4,4], rigid."""
        self._write(GROUNDTRUTH_TOPIC, stamp_ns, bag_messages.pose(T_world_cam, stamp_ns))
        self.poses += 1

    def _write(self, topic: str, stamp_ns: int, message: Any) -> None:
        msgtype = message.__msgtype__
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, msgtype, typestore=STORE)
        self._writer.write(self._connections[topic], stamp_ns,
                           STORE.serialize_cdr(message, msgtype))


def _shift_ns(sequence: Sequence, indices: Indices[int]) -> int:
    first_ns, last_ns = (int(sequence.stamps_ns[indices[i]]) for i in (0, -1))
    # A clock at 0 is one that does not run, a stamp of 0 none at all.
    shift_ns = _SECOND_NS - first_ns if first_ns <= 0 else 0
    if last_ns + shift_ns >= _END_OF_TIME_NS:
        raise DatasetError(sequence.name, f'has a stamp of {last_ns} ns, too late for a ROS '
                           'message', 'correct the stamps')
    return shift_ns


def _poses_near(sequence: Sequence, indices: Indices[int],
                shift_ns: int) -> deque[tuple[int, np.ndarray]]:
    """Shifted stamp and T_world_cam of the ground truth within a second of the images."""
    truth = sequence.groundtruth
    if truth is None:
        return deque()
    first_ns, last_ns = (int(sequence.stamps_ns[indices[i]]) for i in (0, -1))
    near = (truth.stamps_ns >= max(first_ns - _SECOND_NS, 1 - shift_ns)) & (
        truth.stamps_ns <= last_ns + _SECOND_NS)
    return deque((int(truth.stamps_ns[i]) + shift_ns, truth.T_world_cam[i])
                 for i in np.flatnonzero(near))
