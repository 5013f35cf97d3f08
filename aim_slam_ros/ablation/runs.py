"""One run of a comparison, what it is known by, and its figures as a file."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Mapping

from aim_slam_ros.config import Config
from aim_slam_ros.evaluation.metric import Metric, finite


@dataclass(frozen=True)
class Images:
    """Which images of which dataset. source: as load_sequence takes it."""

    source: str
    indices: tuple[int, ...]
    undistort: bool = False


@dataclass(frozen=True)
class Run:
    """What its figures depend on, but for files: the code, the recording, the weights.

    method: one of METHODS.
    """

    images: Images
    config: Config
    method: str

    @property
    def key(self) -> str:
        """The same for runs that give the same, whatever their variants are called."""
        text = json.dumps(self.described(), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def described(self) -> dict[str, Any]:
        return {'images': dataclasses.asdict(self.images), 'method': self.method,
                'config': dataclasses.asdict(self.config)}


class RunFolder:
    """The figures of finished runs, one file each."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def figures(self, run: Run) -> Mapping[str, Metric] | None:
        """None where the run has not finished, or its file was damaged."""
        try:
            return json.loads(self._path(run).read_text(encoding='utf-8'))['metrics']
        except (OSError, ValueError, KeyError, TypeError):
            return None

    def write(self, run: Run, figures: Mapping[str, Metric]) -> None:
        """Whole or not at all, so that an interrupted run is never taken for a finished one."""
        content = {'metrics': finite(figures), 'run': run.described()}
        aside = self._path(run).with_suffix(f'.{os.getpid()}')
        aside.write_text(json.dumps(content, indent=1, allow_nan=False), encoding='utf-8')
        aside.replace(self._path(run))

    def _path(self, run: Run) -> Path:
        return self.folder / f'{run.key}.json'
