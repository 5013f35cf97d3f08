"""A run from its description to its figures."""

from __future__ import annotations

from typing import Callable, Mapping

import cv2
import torch

from aim_slam_ros import offline
from aim_slam_ros.ablation.baselines import averaged, chained
from aim_slam_ros.ablation.runs import Run
from aim_slam_ros.assessment import assess
from aim_slam_ros.config import Config
from aim_slam_ros.datasets import load_sequence
from aim_slam_ros.evaluation.metric import Metric
from aim_slam_ros.frontend.pipeline import FrontendPipeline
from aim_slam_ros.models.base import GeometryModel

_FRONTENDS: Mapping[str, Callable[[Config, GeometryModel], offline.Frontend]] = {
    'slam': FrontendPipeline, 'chain': chained, 'pose_mean': averaged}


def limit_threads(threads: int) -> None:
    """Of torch and OpenCV in this process."""
    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)


def figures_of(run: Run) -> Mapping[str, Metric]:
    """Raises ConfigError and DatasetError as offline.run and load_sequence do, RuntimeError for a
    run that did not come to its end.

    The baselines are the geometry model's own poses: no loop is closed for them.
    """
    config = run.config
    if run.method != 'slam':
        config = config.with_values({'loop_closure.enabled': 'false'})
    sequence = load_sequence(run.images.source, undistort=run.images.undistort)
    result = offline.run(sequence, config, run.images.indices,
                         make_frontend=_FRONTENDS[run.method])
    if result.interrupted:
        raise RuntimeError('the run did not come to its end')
    return assess(result, sequence, config).figures
