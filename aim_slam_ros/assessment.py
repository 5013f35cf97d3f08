"""A run against what its sequence knows to be true: trajectory and surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Iterator, Mapping

import numpy as np
import torch

from aim_slam_ros.config import Config
from aim_slam_ros.datasets.base import Sequence
from aim_slam_ros.evaluation import metrics
from aim_slam_ros.evaluation.metrics import Metric
from aim_slam_ros.evaluation.reconstruction import ReconstructionError, compare_clouds
from aim_slam_ros.evaluation.run_result import Run
from aim_slam_ros.evaluation.trajectory import Incomparable, TrajectoryError, compare
from aim_slam_ros.geometry import camera, sim3
from aim_slam_ros.models.truth import TrueView
from aim_slam_ros.recorded_truth import RecordedTruth

_DEPTH_FRAMES = 100     # of a sequence, at most: bounds time and memory
_STRIDE = 4             # every so many pixels of them, both ways


@dataclass(frozen=True)
class Assessment:
    """error: of the run's trajectory. figures: as metrics.json holds them."""

    error: TrajectoryError | Incomparable
    figures: Mapping[str, Metric]


def assess(run: Run, sequence: Sequence, config: Config) -> Assessment:
    """Every figure of a run over this sequence."""
    truth = sequence.groundtruth
    error = compare(run.trajectory, truth) if truth else \
        Incomparable('there is no ground truth')
    figures = metrics.compute(run, truth, error, _reconstruction(run, sequence, error))
    return Assessment(error, figures | {
        'seed': config.seed, 'model': config.model.name, 'dataset': sequence.name})


def reference_cloud(sequence: Sequence, first_ns: int, last_ns: int) -> np.ndarray | None:
    """What the depth camera saw in this time, [N,3] metres in the ground truth's world.

    From depth images spread evenly over the time, where the ground truth has a pose; None for a
    sequence without depth, intrinsics or ground truth.
    """
    stamps_ns = sequence.stamps_ns
    inside = np.flatnonzero((stamps_ns >= first_ns) & (stamps_ns <= last_ns))
    clouds = [points for part in np.array_split(inside, _DEPTH_FRAMES)
              if (points := next(_views(sequence, part), None)) is not None]
    return np.concatenate(clouds) if clouds else None


def _reconstruction(run: Run, sequence: Sequence,
                    error: TrajectoryError | Incomparable) -> ReconstructionError | None:
    """The map, brought to the ground truth by the trajectory's alignment."""
    if isinstance(error, Incomparable):
        return None
    reference = reference_cloud(sequence, run.results[0].stamp_ns, run.results[-1].stamp_ns)
    if reference is None:
        return None
    T = error.T_reference_estimate
    return compare_clouds(run.map_cloud.points @ T[:3, :3].T + T[:3, 3], reference)


def _views(sequence: Sequence, indices: np.ndarray) -> Iterator[np.ndarray]:
    """The surface [N,3] in each of these images that has a depth and a pose, read when asked."""
    truth = RecordedTruth(sequence)
    for index in indices.tolist():
        view = truth.at(int(sequence.stamps_ns[index]))
        if view is not None:
            yield _world_points(view, index)


def _world_points(view: TrueView, index: int) -> np.ndarray:
    """Every _STRIDE-th pixel; which ones differs from image to image, so that gaps close."""
    points = camera.unproject(torch.from_numpy(view.depth), view.K)
    v, u = divmod(index % _STRIDE ** 2, _STRIDE)
    sampled = points[v::_STRIDE, u::_STRIDE].reshape(-1, 3)
    return sim3.transform(view.T_world_cam, sampled[sampled[:, 2] > 0].double()).numpy()
