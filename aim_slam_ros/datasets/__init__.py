"""Image sequences: TUM RGB-D, EuRoC, folders of images, videos and rendered scenes."""

from __future__ import annotations

from aim_slam_ros.datasets.base import DatasetError, ImageError, Sequence
from aim_slam_ros.datasets.opening import load_sequence

__all__ = ['DatasetError', 'ImageError', 'Sequence', 'load_sequence']
