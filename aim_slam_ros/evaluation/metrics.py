"""The figures of a run, flat, as metrics.json holds them."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Mapping, Sequence

from aim_slam_ros.evaluation.delivery import Delivery
from aim_slam_ros.evaluation.metric import Metric, finite
from aim_slam_ros.evaluation.reconstruction import ReconstructionError
from aim_slam_ros.evaluation.run_result import Run
from aim_slam_ros.evaluation.trajectory import (Incomparable, TrajectoryError, compare, during,
                                                length)
from aim_slam_ros.types import StampedPoses, TrackingStatus

_MODEL_STAGES = ('encode', 'infer')


def compute(run: Run, groundtruth: StampedPoses | None,
            final: TrajectoryError | Incomparable,
            surface: ReconstructionError | None = None) -> dict[str, Metric]:
    """Every figure that follows from a run; None where it is not available.

    final: the error of ``run.trajectory``; surface: of its map.
    """
    causal = _rmse(compare(run.causal_trajectory, groundtruth)) if groundtruth else None
    return {
        'ate_rmse_m': _rmse(final),
        'ate_rmse_causal_m': causal,
        'reconstruction_accuracy_m': surface.accuracy_m if surface else None,
        'reconstruction_completion_m': surface.completion_m if surface else None,
        'reconstruction_chamfer_m': surface.chamfer_m if surface else None,
        **_counts(run),
        **_rates(run),
        **(_delivered(run, run.delivery) if run.delivery else {}),
        'trajectory_length_m': _true_length(run, groundtruth),
        'interrupted': run.interrupted,
        **{f'stage_{name}_ms_per_frame': _ratio(1e3 * seconds, processed(run))
           for name, seconds in run.stage_s.items()},
    }


def processed(run: Run) -> int:
    """The images that stage times are divided by: all, or those that were not dropped."""
    return len(run.results) if run.delivery else run.offered


def write(path: Path, metrics: Mapping[str, Metric]) -> None:
    """JSON; a figure that is not finite becomes null."""
    text = json.dumps(finite(metrics), indent=2, allow_nan=False)
    path.write_text(text + '\n', encoding='utf-8')


def _counts(run: Run) -> dict[str, Metric]:
    """A frame is tracked only when its pose belongs to the largest connected map.

    frames_late: of them, those that waited for the map to begin and were placed afterwards.
    mean_window counts views: the keyframes of an inference and the current frame.
    """
    tracked = len(run.tracked)
    return {
        'frames_offered': run.offered,
        'frames_tracked': tracked,
        'tracked_percent': _ratio(100.0 * tracked, run.offered),
        'frames_late': run.late,
        'frames_skipped': run.count(TrackingStatus.SKIPPED),
        'frames_unreadable': len(run.unreadable),
        'frames_lost': run.count(TrackingStatus.LOST),
        'frames_initialising': run.count(TrackingStatus.INITIALISING),
        'map_pieces': len({keyframe.piece_id for keyframe in run.keyframes}),
        'map_points': len(run.map_cloud.points),
        'keyframes': len(run.keyframes),
        'loops': run.loop_count,
        'inferences': sum(result.inferences for result in run.results),
        'rotation_only_inferences': run.rotation_only_inferences,
        'mean_window': _mean([len(r.window) + 1 for r in run.results if r.window]),
        'mean_kappa': _mean([r.kappa for r in run.results
                             if r.kappa is not None and math.isfinite(r.kappa)]),
    }


def _rates(run: Run) -> dict[str, Metric]:
    """Frames per second from the first image read to the last result, with and without model.

    Over topics the model works beside everything else: there is no time without it.
    """
    model_s = sum(run.stage_s.get(name, 0.0) for name in _MODEL_STAGES)
    without = None if run.delivery else _ratio(run.offered, run.wall_s - model_s)
    return {'wall_s': run.wall_s,
            'rate_hz': _ratio(run.offered, run.wall_s),
            'rate_without_model_hz': without}


def _delivered(run: Run, delivery: Delivery) -> dict[str, Metric]:
    """An image that nothing was said about was dropped: a newer one came while it waited."""
    delivered = len(run.results)
    dropped = run.offered - delivered
    return {
        'frames_delivered': delivered,
        'frames_dropped': dropped,
        'dropped_percent': _ratio(100.0 * dropped, run.offered),
        'tracked_of_delivered_percent': _ratio(100.0 * len(run.tracked), delivered),
        **delivery.figures(),
    }


def _true_length(run: Run, groundtruth: StampedPoses | None) -> float | None:
    """How far the camera really moved while the images were taken."""
    if groundtruth is None or not run.results:
        return None
    return length(during(groundtruth, run.results[0].stamp_ns, run.results[-1].stamp_ns))


def _rmse(error: TrajectoryError | Incomparable) -> float | None:
    return error.ate_rmse_m if isinstance(error, TrajectoryError) else None


def _mean(values: Sequence[float]) -> float | None:
    return sum(values) / len(values) if values else None


def _ratio(numerator: float, denominator: float) -> float | None:
    return numerator / denominator if denominator > 0 else None
