"""What one pass over a bag tells about its images, their calibration and the ground truth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from rosbags.serde import SerdeError
from tqdm import tqdm

from aim_slam_ros.datasets.bag_topics import CAMERA_INFO, ChosenTopics
from aim_slam_ros.datasets.bags import STORE, Bag, BagMessage, header_stamp_ns
from aim_slam_ros.datasets.base import Calibration, DatasetError
from aim_slam_ros.geometry import sim3
from aim_slam_ros.types import StampedPoses
from msg_adapters.encodings import K_from_camera_info, is_rectified, published_size
from msg_adapters.errors import MessageError

# Distortion models of camera_info whose coefficients are those of OpenCV's pinhole camera.
_PINHOLE_MODELS = ('', 'none', 'plumb_bob', 'rational_polynomial')


@dataclass(frozen=True)
class _Pose:
    stamp_ns: int
    log_ns: int
    position: tuple[float, float, float]
    xyzw: tuple[float, float, float, float]


class BagScan:
    """log_ns: of every message of the image topic, as they come. message: the numbers among these
    of the usable ones, stamps_ns: of those; the rest, without a readable header, are ``torn``.

    A topic whose headers all have the stamp 0 has the times of its recording instead; where some
    have another, those with 0 are torn.
    """

    def __init__(self, bag: Bag, topics: ChosenTopics) -> None:
        """Raises DatasetError where the bag is damaged, or has no usable image message."""
        self.stamps_ns: list[int] = []
        self.message: list[int] = []
        self.log_ns: list[int] = []
        self.torn = 0
        self._path = bag.path
        self._topics = topics
        self._camera_info: Any = None
        self._poses: list[_Pose] = []
        with tqdm(total=sum(topic.count for topic in topics.all), desc=f'reading {bag.path.name}',
                  unit=' messages', disable=None, delay=1.0, leave=False) as bar:
            for message in bag.messages([topic.name for topic in topics.all]):
                self._take(message)
                bar.update()
        self._choose_stamps()
        if not self.stamps_ns:
            raise DatasetError(bag.path, f'no message of {topics.image.name} is readable',
                               'record it again, or name another topic with ?topic=TOPIC')

    def _take(self, message: BagMessage) -> None:
        stamp_ns = None if message.cdr is None else header_stamp_ns(message.cdr)
        if message.topic == self._topics.image.name:
            self.log_ns.append(message.log_ns)
            if stamp_ns is None:
                self.torn += 1
                return
            self.stamps_ns.append(stamp_ns)
            self.message.append(len(self.log_ns) - 1)
        elif message.cdr is not None and stamp_ns is not None:
            self._take_other(message, message.cdr, stamp_ns)

    def _choose_stamps(self) -> None:
        if any(self.stamps_ns):
            self.torn += self.stamps_ns.count(0)
            self.message = [m for m, stamp in zip(self.message, self.stamps_ns) if stamp]
            self.stamps_ns = [stamp for stamp in self.stamps_ns if stamp]
        else:
            self.stamps_ns = [self.log_ns[m] for m in self.message]
        if any(pose.stamp_ns for pose in self._poses):
            self._poses = [pose for pose in self._poses if pose.stamp_ns]
        else:
            self._poses = [replace(pose, stamp_ns=pose.log_ns) for pose in self._poses]

    def _take_other(self, message: BagMessage, cdr: bytes, stamp_ns: int) -> None:
        camera_info, truth = self._topics.camera_info, self._topics.groundtruth
        try:
            if camera_info is not None and message.topic == camera_info.name:
                if self._camera_info is None:
                    self._camera_info = STORE.deserialize_cdr(cdr, CAMERA_INFO)
            elif truth is not None:
                self._poses.append(_pose(STORE.deserialize_cdr(cdr, truth.msgtype),
                                         stamp_ns, message.log_ns))
        except SerdeError:
            pass    # one of many: the others say the same

    def calibration(self) -> Calibration | None:
        """None where there is no camera_info, or it says that the camera is uncalibrated."""
        info = self._camera_info
        if info is None:
            return None
        rectified = is_rectified(self._topics.image.name, info)
        if not rectified and info.distortion_model not in _PINHOLE_MODELS:
            return None
        try:
            K = K_from_camera_info(info, rectified)
        except MessageError as error:
            assert self._topics.camera_info is not None
            raise DatasetError(
                self._path, f'{self._topics.camera_info.name}: {error}',
                'name another with ?camera_info=TOPIC, or go without: ?camera_info=none'
                ) from error
        if K is None:
            return None
        distortion = np.array(info.d, np.float64)
        return Calibration(K, distortion if distortion.any() and not rectified else None,
                           *published_size(info))

    def groundtruth(self) -> StampedPoses | None:
        """In time order; poses that are not finite or lack a rotation are left out."""
        if self._topics.groundtruth is None:
            return None
        position = np.array([pose.position for pose in self._poses]).reshape(-1, 3)
        xyzw = np.array([pose.xyzw for pose in self._poses]).reshape(-1, 4)
        usable = (np.isfinite(position).all(1) & np.isfinite(xyzw).all(1)
                  & (np.linalg.norm(xyzw, axis=1) > 0.5))
        if not usable.any():
            raise DatasetError(self._path, f'{self._topics.groundtruth.name} holds no usable pose',
                               'go without ground truth: ?groundtruth=none')
        stamps_ns, first = np.unique(np.array([pose.stamp_ns for pose in self._poses])[usable],
                                     return_index=True)
        rotation = sim3.rotation_from_quaternion(torch.from_numpy(xyzw[usable][first]))
        poses = sim3.from_parts(torch.ones(len(first)), rotation,
                                torch.from_numpy(position[usable][first]))
        return StampedPoses(stamps_ns, poses.numpy())


def _pose(message: Any, stamp_ns: int, log_ns: int) -> _Pose:
    """From PoseStamped, TransformStamped or Odometry."""
    if hasattr(message, 'transform'):
        p, q = message.transform.translation, message.transform.rotation
    else:
        pose = getattr(message.pose, 'pose', message.pose)
        p, q = pose.position, pose.orientation
    return _Pose(stamp_ns, log_ns, (p.x, p.y, p.z), (q.x, q.y, q.z, q.w))
