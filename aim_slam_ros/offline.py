"""Both pipelines over a recorded sequence, in a fixed order and without ROS, so it repeats."""

from __future__ import annotations

import logging
import time
from collections import Counter, defaultdict
from contextlib import contextmanager
from dataclasses import replace
from typing import Callable, Iterator, Protocol, Sequence as Indices

import cv2
import numpy as np
import torch
from torch import Tensor

from aim_slam_ros.config import Config
from aim_slam_ros.datasets.base import DatasetError, ImageError, Sequence
from aim_slam_ros.evaluation.run_result import (LoopPair, PlacedKeyframe, RunResult,
                                                UnreadableImage)
from aim_slam_ros.frontend.pipeline import FrontendPipeline
from aim_slam_ros.loop_closure.pipeline import LoopClosurePipeline
from aim_slam_ros.loop_closure.pose_graph import PoseGraphError
from aim_slam_ros.loop_closure.retrieval import RetrievalError
from aim_slam_ros.models import make_model
from aim_slam_ros.models.base import GeometryModel
from aim_slam_ros.recorded_truth import RecordedTruth
from aim_slam_ros.types import (Cloud, CorrectedKeyframes, FrameResult, Keyframe, KeyframeEvent,
                                TrackingStatus)

_log = logging.getLogger(__name__)
Progress = Callable[[FrameResult | None], None]
_LAST = ('loop_closure', 'correct')    # stages that follow those of the frontend


class Frontend(Protocol):
    """What a run needs of a FrontendPipeline, or of what is measured in its place."""

    @property
    def keyframes(self) -> tuple[Keyframe, ...]:
        """Every keyframe, oldest first."""

    @property
    def rotation_only_inferences(self) -> int:
        """How many inferences found a rotation without parallax."""

    def process(self, stamp_ns: int, image: np.ndarray,
                K: np.ndarray | None = None) -> FrameResult:
        """One image [H,W,3] uint8 RGB, with its intrinsics where known."""

    def apply_correction(self, corrected: CorrectedKeyframes) -> Tensor:
        """Take the poses of loop closure, between two images."""


def run(sequence: Sequence, config: Config, indices: Indices[int],
        progress: Progress = lambda result: None,
        make_frontend: Callable[[Config, GeometryModel], Frontend] = FrontendPipeline
        ) -> RunResult:
    """Process these images of the sequence, every one of them.

    progress: called after each image, with None for an unreadable one. Ctrl-C ends the run, and so
    does what the frontend or the model raises once there are results: what was gathered until then
    is returned, marked as interrupted. Raises ConfigError for a model that
    cannot be made and DatasetError where a calibration is to be used and there is none, or a
    simulated model lacks depth and pose of an image.
    """
    if config.camera.use_calibration and sequence.K is None:
        raise DatasetError(sequence.name, 'has no calibration to use',
                           'add a camera.txt, or leave camera.use_calibration off')
    truth = RecordedTruth(sequence)
    if config.model.name == 'simulated':
        truth.require(indices)
    _seed(config.seed)
    return _Run(sequence, config, truth, make_frontend).over(indices, progress)


def _seed(seed: int) -> None:
    torch.manual_seed(seed)
    np.random.seed(seed)
    cv2.setRNGSeed(seed)


class _Run:
    """The state of one run."""

    def __init__(self, sequence: Sequence, config: Config, truth: RecordedTruth,
                 make_frontend: Callable[[Config, GeometryModel], Frontend]) -> None:
        model = make_model(config, truth)
        self._sequence = sequence
        self._frontend = make_frontend(config, model)
        self._loop_closure = LoopClosurePipeline(config, model)
        self._results: list[FrameResult] = []
        self._unreadable: list[UnreadableImage] = []
        self._stage_s: defaultdict[str, float] = defaultdict(float)

    def over(self, indices: Indices[int], progress: Progress) -> RunResult:
        """Every image in turn, then what came out."""
        interrupted = False
        start = time.perf_counter()
        try:
            for index in indices:
                progress(self._step(index))
        except KeyboardInterrupt:
            interrupted = True
        except Exception:
            if not self._results:
                raise
            _log.exception('the run ends here, after %d images', len(self._results))
            interrupted = True
        return self._result(time.perf_counter() - start, interrupted)

    def _step(self, index: int) -> FrameResult | None:
        """Read, track, close loops, correct."""
        image = self._read(index)
        if image is None:
            return None
        result = self._frontend.process(int(self._sequence.stamps_ns[index]), image,
                                        self._sequence.K)
        self._take_late(result)
        self._results.append(result)
        for stage, seconds in result.stage_s.items():
            self._stage_s[stage] += seconds
        for event in result.events:
            correction = self._loop_closed(event)
            if correction is not None:
                with self._timed('correct'):
                    self._frontend.apply_correction(correction)
        return result

    def _loop_closed(self, event: KeyframeEvent) -> CorrectedKeyframes | None:
        """A keyframe with unusable numbers must not end the run."""
        with self._timed('loop_closure'):
            try:
                return self._loop_closure.add(event)
            except (PoseGraphError, RetrievalError) as error:
                _log.warning('keyframe %d is not used: %s', event.keyframe_id, error)
                return None

    def _take_late(self, result: FrameResult) -> None:
        """Images that waited for the map have their poses now; what they cost stays theirs."""
        late = {waited.stamp_ns: waited for waited in result.late}
        for row, old in enumerate(self._results if late else ()):
            if old.stamp_ns in late:
                self._results[row] = replace(late[old.stamp_ns], inferences=old.inferences,
                                             stage_s=old.stage_s)

    def _read(self, index: int) -> np.ndarray | None:
        with self._timed('read'):
            try:
                return self._sequence.image(index)
            except ImageError as error:
                self._unreadable.append(UnreadableImage(str(error.path), error.reason))
                return None

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self._stage_s[stage] += time.perf_counter() - start

    def _result(self, wall_s: float, interrupted: bool) -> RunResult:
        return RunResult(
            results=tuple(self._results), unreadable=tuple(self._unreadable),
            offered=len(self._results) + len(self._unreadable), wall_s=wall_s,
            stage_s=dict(sorted(self._stage_s.items(), key=lambda item: item[0] in _LAST)),
            keyframes=tuple(PlacedKeyframe(k.keyframe_id, k.piece_id, k.stamp_ns, k.T_world_kf)
                            for k in self._frontend.keyframes),
            loops=tuple(LoopPair(loop.newer, loop.older) for loop in self._loop_closure.loops),
            map_cloud=self._map_cloud(),
            rotation_only_inferences=self._frontend.rotation_only_inferences,
            interrupted=interrupted)

    def _map_cloud(self) -> Cloud:
        """Of the piece that the trajectory is of: the one with most tracked frames."""
        pieces = self._loop_closure.pieces
        frames = Counter(pieces[r.reference_id] for r in self._results
                         if r.status is TrackingStatus.TRACKED and r.reference_id is not None
                         and r.reference_id in pieces)
        return self._loop_closure.fused_map(frames.most_common(1)[0][0] if frames else None)
