"""Figures over seeds as Markdown."""

from __future__ import annotations

import statistics
from dataclasses import dataclass
from typing import Mapping, Sequence

from aim_slam_ros.evaluation.metric import Metric

Figures = Mapping[str, Metric]


@dataclass(frozen=True)
class Row:
    """A variant. runs: by sequence, the figures of every seed, None for a run that failed."""

    name: str
    runs: Mapping[str, Sequence[Figures | None]]


def table(title: str, rows: Sequence[Row], also: Sequence[str] = ()) -> str:
    """ATE and frames tracked by sequence; also: the names of other figures that get a column."""
    sequences = list(rows[0].runs)
    columns = ['ATE RMSE [m]', 'tracked', *also]
    head = ['', *(f'{sequence}: {column}' for sequence in sequences for column in columns)]
    lines = [head, ['---'] + ['---:'] * (len(head) - 1)]
    lines += [[row.name, *(cell for sequence in sequences
                           for cell in _cells(row.runs[sequence], also))] for row in rows]
    return '\n'.join([f'### {title}', '', *(f'| {" | ".join(line)} |' for line in lines)])


def _cells(runs: Sequence[Figures | None], also: Sequence[str]) -> list[str]:
    done = [figures for figures in runs if figures is not None]
    if not done:
        return ['failed'] + ['–'] * (1 + len(also))
    return [_spread(runs, 'ate_rmse_m', '.4f'), _tracked(done),
            *(_spread(runs, name, '.4g') for name in also)]


def _spread(runs: Sequence[Figures | None], name: str, form: str) -> str:
    """Mean ± standard deviation over the seeds; says how many had the figure if not all."""
    values = [float(value) for figures in runs if figures is not None
              and isinstance(value := figures.get(name), (int, float))]
    if not values:
        return '–'
    text = f'{statistics.fmean(values):{form}}'
    if len(values) > 1:
        text += f' ± {statistics.stdev(values):{form}}'
    return text if len(values) == len(runs) else f'{text} ({len(values)} of {len(runs)})'


def _tracked(done: Sequence[Figures]) -> str:
    """Mean ± deviation where they differ, of the frames offered."""
    counts = [float(figures['frames_tracked'] or 0) for figures in done]
    mean = statistics.fmean(counts)
    text = f'{mean:.0f}' if mean.is_integer() else f'{mean:.1f}'
    if len(counts) > 1 and statistics.stdev(counts) > 0:
        text += f' ± {statistics.stdev(counts):.1f}'
    return f'{text} / {done[0]["frames_offered"]}'
