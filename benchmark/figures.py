"""Figures of a benchmark: ``name: number``, the unit in the name; printed one a line."""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path

Figures = dict[str, float | None]


def parser(doc: str | None) -> argparse.ArgumentParser:
    """What every benchmark takes; doc: its module's docstring."""
    made = argparse.ArgumentParser(description=doc,
                                   formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument('--out', type=Path, required=True, metavar='FOLDER',
                      help='add to benchmark.json there')
    return made


def said(figures: Figures) -> Figures:
    """Print them as they come."""
    for name, value in figures.items():
        shown = 'none' if value is None or not math.isfinite(value) else f'{value:.4g}'
        print(f'{name}: {shown}', flush=True)
    return figures


def add(folder: Path, figures: Figures) -> None:
    """Into the folder's benchmark.json; those of other benchmarks stay."""
    path = folder / 'benchmark.json'
    known = json.loads(path.read_text(encoding='utf-8')) if path.exists() else {}
    path.write_text(json.dumps(known | figures, indent=2) + '\n', encoding='utf-8')
