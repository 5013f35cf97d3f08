"""placeholder while being written"""
from __future__ import annotations
from pathlib import Path
from aim_slam_ros.datasets.base import DatasetError, Sequence
PREFIX = 'rendered:'


def load_rendered(source: str, cache_dir: Path | None) -> Sequence:
    raise DatasetError(source, 'not yet', 'wait')
