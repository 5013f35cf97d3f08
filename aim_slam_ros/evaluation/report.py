"""One page that shows how a run went."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

from aim_slam_ros.evaluation import orthographic
from aim_slam_ros.evaluation.trajectory import Incomparable, TrajectoryError, during
from aim_slam_ros.evaluation.viewpoint import view_axes
from aim_slam_ros.types import Cloud, FrameResult, StampedPoses, TrackingStatus

_ESTIMATE, _TRUTH, _LOSS, _BAR = '#d1495b', '#222222', '#f2b8a0', '#30638e'
_EMPTY_MAP = '#eef0f2'


@dataclass(frozen=True)
class ReportData:
    """What the page shows.

    trajectory: every tracked frame, in the estimate's world. cloud: in the same world.
    groundtruth: metres, or None. error: of the trajectory against it. results: one per image.
    stage_ms: milliseconds per image, in the order of the stages. table: name and value pairs.
    """

    title: str
    trajectory: StampedPoses
    groundtruth: StampedPoses | None
    error: TrajectoryError | Incomparable
    cloud: Cloud
    results: tuple[FrameResult, ...]
    stage_ms: Mapping[str, float]
    table: tuple[tuple[str, str], ...]


def write_report(path: Path, data: ReportData) -> None:
    """A PNG: trajectory, map from above and from the side, error, time per stage, figures."""
    figure = Figure(figsize=(18, 10.5), dpi=100, layout='constrained')
    FigureCanvasAgg(figure)
    figure.suptitle(data.title, fontsize=15, fontweight='bold')
    axes = figure.subplots(2, 3, gridspec_kw={'height_ratios': [1.35, 1.0]})
    scene = _Scene(data)
    _draw_trajectory(axes[0, 0], scene)
    _draw_map(axes[0, 1], scene, 'Map from above', _ABOVE)
    _draw_map(axes[0, 2], scene, 'Map from the side', _SIDE)
    _draw_over_time(axes[1, 0], data)
    _draw_stages(axes[1, 1], data.stage_ms)
    _draw_table(axes[1, 2], data.table)
    figure.savefig(path)


# A view: which of right, away and up run along the page's right, its top and into it.
_ABOVE = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, -1]])
_SIDE = np.array([[1.0, 0, 0], [0, 0, 1], [0, 1, 0]])


class _Scene:
    """Path, ground truth and map, turned to the viewer: right, away, up."""

    def __init__(self, data: ReportData) -> None:
        self._data = data
        self.metric = isinstance(data.error, TrajectoryError)
        self.unit = 'm' if self.metric else 'map units'

    @cached_property
    def _T(self) -> np.ndarray:
        """[4,4]: the estimate's world in the ground truth's, where that is known."""
        error = self._data.error
        return error.T_reference_estimate if isinstance(error, TrajectoryError) else np.eye(4)

    @cached_property
    def _axes(self) -> np.ndarray:
        poses = self._data.trajectory
        if not len(poses):
            return np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
        R = self._T[:3, :3] / np.cbrt(np.linalg.det(self._T[:3, :3]))
        placed = poses.T_world_cam.copy()
        placed[:, :3, :3] = R @ placed[:, :3, :3]
        placed[:, :3, 3] = self._placed(placed[:, :3, 3])
        return view_axes(StampedPoses(poses.stamps_ns, placed),
                         self._placed(self._data.cloud.points), surveyed=self.metric)

    def _placed(self, points: np.ndarray) -> np.ndarray:
        return points @ self._T[:3, :3].T + self._T[:3, 3]

    @cached_property
    def path(self) -> np.ndarray:
        """[N,3] estimated positions, broken by nan where frames are missing in between."""
        positions = self._placed(self._data.trajectory.T_world_cam[:, :3, 3]) @ self._axes.T
        return np.insert(positions, _gaps(self._data), np.nan, axis=0)

    @cached_property
    def truth(self) -> np.ndarray | None:
        """[M,3] true positions over the time of the images."""
        poses, results = self._data.groundtruth, self._data.results
        if poses is None or not self.metric or not results:
            return None
        seen = during(poses, results[0].stamp_ns, results[-1].stamp_ns)
        return seen.T_world_cam[:, :3, 3] @ self._axes.T

    @cached_property
    def cloud(self) -> Cloud:
        points = self._placed(self._data.cloud.points) @ self._axes.T
        return Cloud(points, self._data.cloud.colours)


def _gaps(data: ReportData) -> np.ndarray:
    """Indices into the trajectory before which images were offered but not tracked."""
    offered = np.array([result.stamp_ns for result in data.results], np.int64)
    position = np.searchsorted(offered, data.trajectory.stamps_ns)
    return np.flatnonzero(np.diff(position) > 1) + 1


def _draw_trajectory(axes: Axes, scene: _Scene) -> None:
    """Seen from above, in the same directions as the map."""
    axes.set_title('Trajectory from above')
    if scene.truth is not None:
        axes.plot(*scene.truth[:, :2].T, color=_TRUTH, linewidth=2.5, alpha=0.45,
                  label='ground truth')
    axes.plot(*scene.path[:, :2].T, color=_ESTIMATE, linewidth=1.3, label='estimate')
    if len(scene.path):
        axes.plot(*scene.path[0, :2], 'o', color=_ESTIMATE, markersize=7, label='start')
    else:
        _say(axes, 'no frame was tracked')
    _equal(axes, scene.unit)
    axes.grid(alpha=0.3)
    axes.legend(loc='best', framealpha=0.8)


def _draw_map(axes: Axes, scene: _Scene, title: str, view: np.ndarray) -> None:
    """view: [3,3], rows are the page's right, top and depth in right, away and up."""
    axes.set_title(title)
    axes.set_facecolor(_EMPTY_MAP)
    path = scene.path @ view.T
    known = path[np.isfinite(path[:, 0])]
    nearest = float(known[:, 2].min()) if len(known) else -np.inf
    raster = orthographic.draw(Cloud(scene.cloud.points @ view.T, scene.cloud.colours),
                               known[:, :2], nearest)
    if raster is None:
        _say(axes, 'the map is empty')
        return
    axes.imshow(raster.image, extent=raster.extent, interpolation='antialiased')
    axes.plot(*path[:, :2].T, color='white', linewidth=2.4)
    axes.plot(*path[:, :2].T, color=_ESTIMATE, linewidth=1.2)
    _equal(axes, scene.unit)


def _draw_over_time(axes: Axes, data: ReportData) -> None:
    """The error, or how much was matched where there is no ground truth; losses shaded."""
    start_ns = data.results[0].stamp_ns if data.results else 0
    if isinstance(data.error, TrajectoryError):
        axes.set_title(f'Position error (ATE RMSE {100 * data.error.ate_rmse_m:.1f} cm)')
        axes.set_ylabel('error [cm]')
        seconds = (data.error.aligned.stamps_ns - start_ns) / 1e9
        axes.plot(seconds, 100 * data.error.errors_m, '.', markersize=3, color=_BAR)
        axes.axhline(100 * data.error.ate_rmse_m, color=_ESTIMATE, linewidth=1, label='RMSE')
    else:
        axes.set_title(f'Matched fraction (no error: {data.error.reason})', fontsize=10,
                       wrap=True)
        tracked = [r for r in data.results if r.status is TrackingStatus.TRACKED]
        axes.plot([(r.stamp_ns - start_ns) / 1e9 for r in tracked],
                  [r.matched_fraction for r in tracked], '.', markersize=3, color=_BAR)
    axes.set_ylim(bottom=0)
    _shade_losses(axes, data, start_ns)
    axes.set_xlabel('time [s]')
    axes.grid(alpha=0.3)
    if axes.get_legend_handles_labels()[1]:
        axes.legend(loc='best', framealpha=0.8)


def _shade_losses(axes: Axes, data: ReportData, start_ns: int) -> None:
    """Spans of images without a place in the largest map."""
    placed = set(data.trajectory.stamps_ns.tolist())
    stamps = [result.stamp_ns for result in data.results]
    ends = stamps[1:] + stamps[-1:]
    label = 'not tracked'
    for begin, end in _spans([s not in placed for s in stamps], stamps, ends):
        axes.axvspan((begin - start_ns) / 1e9, (end - start_ns) / 1e9, color=_LOSS, alpha=0.6,
                     linewidth=0.8, zorder=0, label=label)
        label = '_again'    # one entry in the legend is enough


def _spans(marked: Sequence[bool], begins: Sequence[int],
           ends: Sequence[int]) -> list[tuple[int, int]]:
    """Begin and end of every run of marked items."""
    edges = np.flatnonzero(np.diff(np.array([0, *marked, 0], np.int8)))
    return [(begins[first], ends[after - 1]) for first, after in zip(edges[::2], edges[1::2])]


def _draw_stages(axes: Axes, stage_ms: Mapping[str, float]) -> None:
    axes.set_title(f'Time per image ({sum(stage_ms.values()):.0f} ms)')
    bars = axes.barh(list(stage_ms), list(stage_ms.values()), color=_BAR)
    axes.bar_label(bars, fmt='%.1f', padding=3)
    axes.invert_yaxis()
    axes.set_xlabel('milliseconds per image')
    axes.margins(x=0.12)
    axes.grid(axis='x', alpha=0.3)


def _draw_table(axes: Axes, rows: Sequence[tuple[str, str]]) -> None:
    axes.axis('off')
    if not rows:
        return
    table = axes.table(cellText=[list(row) for row in rows], cellLoc='left',
                       colWidths=[0.6, 0.4], bbox=Bbox.unit(), edges='horizontal')
    table.auto_set_font_size(False)
    table.set_fontsize(10.5)
    for cell in table.get_celld().values():
        cell.set_edgecolor('#cccccc')


def _equal(axes: Axes, unit: str) -> None:
    axes.set_aspect('equal', adjustable='datalim' if not axes.images else 'box')
    axes.set_xlabel(f'[{unit}]')


def _say(axes: Axes, text: str) -> None:
    axes.text(0.5, 0.5, text, ha='center', va='center', transform=axes.transAxes)
