"""The files of a result folder."""

from __future__ import annotations

from pathlib import Path
from typing import Mapping

from aim_slam_ros.assessment import assess
from aim_slam_ros.config import Config
from aim_slam_ros.datasets.base import Sequence
from aim_slam_ros.datasets.text import write_tum_trajectory
from aim_slam_ros.evaluation import metrics
from aim_slam_ros.evaluation.metrics import Metric
from aim_slam_ros.evaluation.reconstruction import write_ply
from aim_slam_ros.evaluation.report import ReportData, write_report
from aim_slam_ros.evaluation.run_result import Run
from aim_slam_ros.evaluation.trajectory import Incomparable, TrajectoryError

_Rows = tuple[tuple[str, str, str], ...]    # metric, its name for a person, format
_TRAJECTORY: _Rows = (
    ('ate_rmse_m', 'ATE RMSE, final [m]', '{:.4f}'),
    ('ate_rmse_causal_m', 'ATE RMSE, as reported [m]', '{:.4f}'),
    ('frames_offered', 'images offered', '{}'),
    ('tracked_percent', 'tracked [%]', '{:.1f}'),
)
_SURFACE: _Rows = (
    ('surface', 'map accuracy / completion [m]', '{}'),
    ('reconstruction_chamfer_m', 'map chamfer distance [m]', '{:.3f}'),
)
_DELIVERY: _Rows = (
    ('dropped', 'dropped', '{}'),
    ('tracked_of_delivered_percent', 'tracked of those not dropped [%]', '{:.1f}'),
    ('latency', 'latency, median / 95 % / 99 % [ms]', '{}'),
)
_MAP: _Rows = (
    ('frames_lost', 'lost', '{}'),
    ('frames_skipped', 'skipped', '{}'),
    ('frames_unreadable', 'unreadable', '{}'),
    ('map_pieces', 'map pieces', '{}'),
    ('keyframes', 'keyframes', '{}'),
    ('loops', 'loops closed', '{}'),
    ('inferences', 'inferences', '{}'),
    ('mean_window', 'views per inference', '{:.2f}'),
    ('rate_hz', 'rate [images/s]', '{:.1f}'),
)
_WITHOUT_MODEL: _Rows = (
    ('rate_without_model_hz', 'rate without the model [images/s]', '{:.1f}'),
)
_SEED: _Rows = (('seed', 'seed', '{}'),)


def write_results(folder: Path, sequence: Sequence, config: Config, run: Run) -> None:
    """Write every file and print the table, the report's path last."""
    assessment = assess(run, sequence, config)
    table = _table(assessment.figures, run)
    write_tum_trajectory(folder / 'trajectory.txt', run.trajectory)
    write_tum_trajectory(folder / 'keyframes.txt', run.keyframe_trajectory)
    write_ply(folder / 'map.ply', run.map_cloud)
    (folder / 'config.yaml').write_text(config.to_yaml(), encoding='utf-8')
    metrics.write(folder / 'metrics.json', assessment.figures)
    write_report(folder / 'report.png', _report(sequence, config, run, assessment.error, table))
    _print(run, assessment.error, table)
    print(folder / 'report.png')


def _report(sequence: Sequence, config: Config, run: Run,
            error: TrajectoryError | Incomparable,
            table: tuple[tuple[str, str], ...]) -> ReportData:
    ending = ' (interrupted)' if run.interrupted else ''
    per_frame_ms = 1e3 / max(metrics.processed(run), 1)
    return ReportData(
        title=f'{sequence.name}, model {config.model.name}{ending}',
        trajectory=run.trajectory, groundtruth=sequence.groundtruth, error=error,
        cloud=run.map_cloud, results=run.results,
        stage_ms={name: per_frame_ms * seconds for name, seconds in run.stage_s.items()},
        table=table)


def _table(figures: Mapping[str, Metric], run: Run) -> tuple[tuple[str, str], ...]:
    rows = _TRAJECTORY + _SURFACE + _DELIVERY + _MAP + _SEED if run.delivery else \
        _TRAJECTORY + _SURFACE + _MAP + _WITHOUT_MODEL + _SEED
    shown = {**figures, 'surface': _surface(figures),
             **(_delivered(figures) if run.delivery else {})}
    return tuple((label, '–' if shown[name] is None else form.format(shown[name]))
                 for name, label, form in rows)


def _surface(figures: Mapping[str, Metric]) -> str | None:
    values = [figures[f'reconstruction_{name}_m'] for name in ('accuracy', 'completion')]
    return None if None in values else ' / '.join(f'{value:.3f}' for value in values)


def _delivered(figures: Mapping[str, Metric]) -> dict[str, Metric]:
    """Figures that share a line of the table."""
    latencies = [figures[f'latency_ms_{name}'] for name in ('p50', 'p95', 'p99')]
    share = figures['dropped_percent']
    return {'dropped': None if share is None else f'{figures["frames_dropped"]} ({share:.1f} %)',
            'latency': None if None in latencies else
            ' / '.join(f'{value:.0f}' for value in latencies)}


def _print(run: Run, error: TrajectoryError | Incomparable,
           table: tuple[tuple[str, str], ...]) -> None:
    for unreadable in run.unreadable:
        print(f'skipped {unreadable.path}: {unreadable.reason}')
    width = max(len(label) for label, _ in table)
    for label, value in table:
        print(f'{label:<{width}}  {value}')
    if isinstance(error, Incomparable):
        print(f'no trajectory error: {error.reason}')
    if run.interrupted:
        print(f'interrupted after {run.offered} images')
