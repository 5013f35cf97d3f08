"""The EuRoC ASL form: mav0/cam0 with data.csv, sensor.yaml and data/."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from aim_slam_ros.datasets.base import Calibration, DatasetError, Sequence
from aim_slam_ros.datasets.images import check_size, read_image
from aim_slam_ros.datasets.text import poses_from_rows, read_stamped_list, read_text
from aim_slam_ros.types import StampedPoses

_GROUNDTRUTH = 'state_groundtruth_estimate0'


@dataclass(frozen=True)
class SensorFile:
    """What sensor.yaml says.

    calibration: None where its camera or distortion model is not OpenCV's pinhole one.
    T_body_cam: [4,4] float64, rigid, from the camera to the IMU body.
    """

    calibration: Calibration | None
    T_body_cam: np.ndarray | None


def find_cam0(folder: Path) -> Path | None:
    """cam0, given the folder that holds mav0, mav0 itself or cam0; None if it is not there."""
    for cam0 in (folder / 'mav0' / 'cam0', folder / 'cam0', folder):
        if (cam0 / 'data.csv').exists() and (cam0 / 'data').is_dir():
            return cam0
    return None


class EurocSequence(Sequence):
    """The left camera of an ASL folder; its ground truth is brought from the body to cam0."""

    def __init__(self, cam0: Path) -> None:
        """Raises DatasetError."""
        listed = read_stamped_list(cam0 / 'data.csv', 'timestamp [ns],filename', 2, ',', int)
        sensor = _read_sensor(cam0 / 'sensor.yaml')
        # Not resolve(): a linked cam0 still has its ground truth beside the link.
        whole = Path(os.path.abspath(cam0))
        truth = whole.parent / _GROUNDTRUTH / 'data.csv'
        super().__init__(_name(whole), listed.stamps_ns, sensor.calibration,
                         _read_groundtruth(truth, cam0, sensor) if truth.exists() else None,
                         listed.dropped_stamps, listed.unreadable_lines)
        self._files = [cam0 / 'data' / value[0] for value in listed.values]
        check_size(self._files[0], self.calibration)

    def image(self, index: int) -> np.ndarray:
        return read_image(self._files[index])


def _name(cam0: Path) -> str:
    mav0 = cam0.parent
    return mav0.parent.name if mav0.name == 'mav0' else mav0.name


def _read_groundtruth(path: Path, cam0: Path, sensor: SensorFile) -> StampedPoses:
    """T_world_cam = T_world_body T_body_cam; columns are ns, p xyz, q wxyz, then velocities."""
    if sensor.T_body_cam is None:
        raise DatasetError(cam0 / 'sensor.yaml', 'lacks T_BS, which places the camera on the body '
                           'that the ground truth is about',
                           f'restore it, or move {path.parent} away to go without ground truth')
    form = 'timestamp [ns],px,py,pz,qw,qx,qy,qz'
    body = poses_from_rows(path, read_stamped_list(path, form, 8, ',', int), (4, 5, 6, 3))
    return StampedPoses(body.stamps_ns, body.T_world_cam @ sensor.T_body_cam)


def _read_sensor(path: Path) -> SensorFile:
    if not path.exists():
        return SensorFile(None, None)
    # OpenCV's %YAML:1.0 header is no YAML.
    text = '\n'.join(line for line in read_text(path).splitlines() if not line.startswith('%'))
    try:
        content = yaml.safe_load(text)
        return SensorFile(_calibration(content), _transform(content))
    except (yaml.YAMLError, KeyError, TypeError, ValueError) as error:
        raise DatasetError(path, f'is not an ASL sensor.yaml of a camera ({error!r})',
                           'restore it from the dataset') from error


def _calibration(content: dict[str, Any]) -> Calibration | None:
    known = (content.get('camera_model', 'pinhole') == 'pinhole'
             and content.get('distortion_model', 'radial-tangential')
             in ('radial-tangential', 'radtan', 'plumb_bob', 'none'))
    if 'intrinsics' not in content or not known:
        return None
    fx, fy, cx, cy = (float(value) for value in content['intrinsics'])
    distortion = np.array(content.get('distortion_coefficients', []), np.float64)
    width, height = content.get('resolution', (0, 0))
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return Calibration(K, distortion if distortion.any() else None, int(width), int(height))


def _transform(content: dict[str, Any]) -> np.ndarray | None:
    if 'T_BS' not in content:
        return None
    return np.array(content['T_BS']['data'], np.float64).reshape(4, 4)
