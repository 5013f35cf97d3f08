"""The figures of both pipelines on recorded and rendered sequences, one a line.

    .venv/bin/python benchmark/offline.py --data FOLDER --out FOLDER [--seeds 3] [--only NAME ...]

Every 2nd image, default settings (focal length unknown). FOLDER holds tum_fr1_xyz, redkitchen_600,
tum_fr1_rpy_300 and kitti00_120 in TUM RGB-D form; those that are missing are skipped and said.
Adds to benchmark.json: ``name: number``, the unit in the name.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from figures import Figures, add, parser, said
from scipy.spatial import cKDTree

from aim_slam_ros import offline
from aim_slam_ros.config import Config
from aim_slam_ros.datasets import DatasetError, Sequence, load_sequence
from aim_slam_ros.evaluation.run_result import RunResult
from aim_slam_ros.evaluation.trajectory import Incomparable, compare

STRIDE = 2
EVERY_IMAGE_FRAMES = 300   # inferring for every image is measured on this many images


@dataclass(frozen=True)
class Case:
    """A sequence and what is measured on it."""

    name: str
    source: str
    seeds: bool = True              # more than one
    without_loops: bool = False     # once more without loop closure
    every_image: bool = False       # once more with an inference for every image


CASES = (Case('tum_fr1_xyz', 'tum_fr1_xyz', every_image=True),
         Case('redkitchen_600', 'redkitchen_600', every_image=True),
         Case('corridor', 'rendered:corridor', without_loops=True),
         Case('tum_fr1_rpy_300', 'tum_fr1_rpy_300', seeds=False),
         Case('kitti00_120', 'kitti00_120', seeds=False))


def main() -> int:
    arguments = parser(__doc__)
    arguments.add_argument('--data', type=Path, required=True)
    arguments.add_argument('--seeds', type=int, default=3)
    arguments.add_argument('--only', nargs='*', choices=[case.name for case in CASES])
    args = arguments.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    figures: Figures = {}
    for case in CASES:
        if args.only and case.name not in args.only:
            continue
        source = case.source if ':' in case.source else str(args.data / case.source)
        try:
            sequence = load_sequence(source)
        except DatasetError as error:
            print(f'# {case.name} skipped: {error}', file=sys.stderr)
            continue
        figures |= _measure(case, sequence, args.seeds if case.seeds else 1)
    add(args.out, figures)
    return 0


def _measure(case: Case, sequence: Sequence, seeds: int) -> Figures:
    figures = _seeds(case.name, sequence, {}, seeds)
    if case.without_loops:
        name = f'{case.name}_no_loop_closure'
        figures |= _seeds(name, sequence, {'loop_closure.enabled': 'false'}, seeds)
        with_loops, without = (figures[f'{n}_ate_rmse_m_mean'] for n in (case.name, name))
        if with_loops and without:
            figures |= said({f'{case.name}_ate_less_with_loops_percent':
                             100.0 * (1.0 - with_loops / without)})
    if case.every_image:
        run = _run(sequence, {'model.infer': 'every_image'},
                   range(0, min(EVERY_IMAGE_FRAMES, len(sequence)), STRIDE))
        figures |= said({f'{case.name}_every_image_rate_hz': run.offered / run.wall_s,
                         f'{case.name}_every_image_ate_rmse_m': _ate(run, sequence)})
    return figures


def _seeds(name: str, sequence: Sequence, settings: dict[str, str], seeds: int) -> Figures:
    figures: Figures = {}
    for seed in range(seeds):
        run = _run(sequence, settings | {'seed': str(seed)}, range(0, len(sequence), STRIDE))
        figures |= said({f'{name}_{key}_seed{seed}': value
                         for key, value in _figures(run, sequence).items()})
    errors = [figures[f'{name}_ate_rmse_m_seed{seed}'] for seed in range(seeds)]
    known = [error for error in errors if error is not None]
    return figures | said({f'{name}_ate_rmse_m_mean':
                           float(np.mean(known)) if known else None})


def _run(sequence: Sequence, settings: dict[str, str], indices: range) -> RunResult:
    return offline.run(sequence, Config().with_values(settings), indices)


def _figures(run: RunResult, sequence: Sequence) -> Figures:
    overlaps = [_overlap(run, sequence, loop.newer, loop.older) for loop in run.loops]
    known = [overlap for overlap in overlaps if overlap is not None]
    return {'ate_rmse_m': _ate(run, sequence),
            'tracked_percent': 100.0 * len(run.tracked) / run.offered,
            'map_pieces': len({keyframe.piece_id for keyframe in run.keyframes}),
            'not_finite_poses': int((~np.isfinite(run.trajectory.T_world_cam)).any((1, 2)).sum()),
            'rotation_only_inferences': run.rotation_only_inferences,
            'loops': len(run.loops),
            'least_loop_overlap_percent': 100.0 * min(known) if known else None,
            'rate_hz': run.offered / run.wall_s}


def _ate(run: RunResult, sequence: Sequence) -> float | None:
    if sequence.groundtruth is None:
        return None
    error = compare(run.trajectory, sequence.groundtruth)
    return None if isinstance(error, Incomparable) else error.ate_rmse_m


def _overlap(run: RunResult, sequence: Sequence, newer: int, older: int) -> float | None:
    """Share of the older keyframe's true surface that the newer one truly sees.

    From the sensor's depth and the ground truth nearest in time to either keyframe: points of the
    older view that lie in the newer image and near a point of its depth.
    """
    stamps = {keyframe.keyframe_id: keyframe.stamp_ns for keyframe in run.keyframes}
    clouds = [_true_points(sequence, stamps[k]) for k in (older, newer)]
    if clouds[0] is None or clouds[1] is None:
        return None
    tree = cKDTree(clouds[1])
    distance, _ = tree.query(clouds[0], distance_upper_bound=0.1)
    return float(np.isfinite(distance).mean())


def _true_points(sequence: Sequence, stamp_ns: int) -> np.ndarray | None:
    """[N,3] metres in the ground truth's world: the sensor's depth nearest to this time."""
    truth, K = sequence.groundtruth, sequence.K
    index = int(np.abs(sequence.stamps_ns - stamp_ns).argmin())
    near = sorted(range(max(0, index - 5), min(len(sequence), index + 6)),
                  key=lambda i: abs(i - index))
    depth, at = next(((d, i) for i in near if (d := sequence.depth(i)) is not None), (None, 0))
    if depth is None or truth is None or K is None:
        return None
    T = truth.T_world_cam[int(np.abs(truth.stamps_ns - sequence.stamps_ns[at]).argmin())]
    v, u = np.mgrid[:depth.shape[0]:8, :depth.shape[1]:8]
    z = depth[::8, ::8]
    points = np.stack([(u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z, z], -1)
    return points[z > 0] @ T[:3, :3].T + T[:3, 3]


if __name__ == '__main__':
    sys.exit(main())
