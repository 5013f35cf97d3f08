"""The files of a result folder."""

from __future__ import annotations

from pathlib import Path

from aim_slam_ros.config import Config
from aim_slam_ros.datasets.base import Sequence
from aim_slam_ros.datasets.text import write_tum_trajectory
from aim_slam_ros.evaluation import metrics
from aim_slam_ros.evaluation.metrics import Metric
from aim_slam_ros.evaluation.reconstruction import write_ply
from aim_slam_ros.evaluation.report import ReportData, write_report
from aim_slam_ros.evaluation.run_result import RunResult
from aim_slam_ros.evaluation.trajectory import Incomparable, TrajectoryError, compare

_TABLE = (  # metric, its name for a person, format
    ('ate_rmse_m', 'ATE RMSE, final [m]', '{:.4f}'),
    ('ate_rmse_causal_m', 'ATE RMSE, as reported [m]', '{:.4f}'),
    ('frames_offered', 'images offered', '{}'),
    ('tracked_percent', 'tracked [%]', '{:.1f}'),
    ('frames_lost', 'lost', '{}'),
    ('frames_skipped', 'skipped', '{}'),
    ('frames_unreadable', 'unreadable', '{}'),
    ('map_pieces', 'map pieces', '{}'),
    ('keyframes', 'keyframes', '{}'),
    ('loops', 'loops closed', '{}'),
    ('inferences', 'inferences', '{}'),
    ('mean_window', 'views per inference', '{:.2f}'),
    ('rate_hz', 'rate [images/s]', '{:.1f}'),
    ('rate_without_model_hz', 'rate without the model [images/s]', '{:.1f}'),
    ('seed', 'seed', '{}'),
)


def write_results(folder: Path, sequence: Sequence, config: Config, run: RunResult) -> None:
    """Write every file and print the table, the report's path last."""
    truth = sequence.groundtruth
    error = compare(run.trajectory, truth) if truth else \
        Incomparable('there is no ground truth')
    figures = metrics.compute(run, truth, error) | {
        'seed': config.seed, 'model': config.model.name, 'dataset': sequence.name}
    table = _table(figures)
    write_tum_trajectory(folder / 'trajectory.txt', run.trajectory)
    write_tum_trajectory(folder / 'keyframes.txt', run.keyframe_trajectory)
    write_ply(folder / 'map.ply', run.map_cloud)
    (folder / 'config.yaml').write_text(config.to_yaml(), encoding='utf-8')
    metrics.write(folder / 'metrics.json', figures)
    write_report(folder / 'report.png', _report(sequence, config, run, error, table))
    _print(run, error, table)
    print(folder / 'report.png')


def _report(sequence: Sequence, config: Config, run: RunResult,
            error: TrajectoryError | Incomparable,
            table: tuple[tuple[str, str], ...]) -> ReportData:
    ending = ' (interrupted)' if run.interrupted else ''
    per_frame_ms = 1e3 / max(run.offered, 1)
    return ReportData(
        title=f'{sequence.name}, model {config.model.name}{ending}',
        trajectory=run.trajectory, groundtruth=sequence.groundtruth, error=error,
        cloud=run.map_cloud, results=run.results,
        stage_ms={name: per_frame_ms * seconds for name, seconds in run.stage_s.items()},
        table=table)


def _table(figures: dict[str, Metric]) -> tuple[tuple[str, str], ...]:
    return tuple((label, '–' if figures[name] is None else form.format(figures[name]))
                 for name, label, form in _TABLE)


def _print(run: RunResult, error: TrajectoryError | Incomparable,
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
