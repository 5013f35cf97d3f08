"""The frontend with the model in a thread of its own: following never waits for an inference."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from queue import SimpleQueue
from typing import Callable

import numpy as np
from torch import Tensor

from ..config import Config
from ..models.base import GeometryModel
from ..types import CorrectedKeyframes, FrameResult, KeyframeEvent, TrackingStatus
from .inquiry import Findings, Inquiry
from .odometry import OdometryFrame
from .pipeline import FrontendPipeline


class ModelFailure(RuntimeError):
    """What the model raised is the cause. result: of its image, where that has none yet."""

    def __init__(self, error: Exception, result: FrameResult | None) -> None:
        super().__init__(f'the model failed: {type(error).__name__}: {error}')
        self.result = result


@dataclass(frozen=True)
class PlacedResult:
    """A result in the odom frame.

    T_odom_cam: [4,4] float64, rigid; None unless tracked. T_odom_world: [4,4] float64 Sim(3), good
    for this result and its events. again: what the model added to a result that was given before.
    """

    result: FrameResult
    T_odom_cam: Tensor | None
    T_odom_world: Tensor
    again: bool = False


class ConcurrentFrontend:
    """Two threads: the caller's follows images, this object's own asks the model.

    The map is written by the caller's thread alone, and only while no inquiry is under way.
    """

    def __init__(self, config: Config, model: GeometryModel,
                 on_answer: Callable[[], None] = lambda: None) -> None:
        """on_answer: called in the model's thread when ``collect`` has something to give."""
        self._pipeline = FrontendPipeline(config, model)
        self._odometry = OdometryFrame()
        self._pieces_begun = self._pipeline.pieces_begun
        self._on_answer = on_answer
        self._inquiries: SimpleQueue[Inquiry | None] = SimpleQueue()
        self._asked: Inquiry | None = None
        self._had_pose = False
        self._findings: Findings | Exception | None = None
        self._correction: CorrectedKeyframes | None = None
        threading.Thread(target=self._work, name='model', daemon=True).start()

    @property
    def pipeline(self) -> FrontendPipeline:
        """For what it knows; it is driven from here alone."""
        return self._pipeline

    @property
    def busy(self) -> bool:
        """Whether the model is at work."""
        return self._asked is not None

    def process(self, stamp_ns: int, image: np.ndarray,
                K: np.ndarray | None = None) -> list[PlacedResult]:
        """One image as FrontendPipeline takes it, and its result; ``collect`` first.

        An image that only the model can place has its result from ``collect``.
        """
        step = self._pipeline.begin(stamp_ns, image, K, may_ask=not self.busy)
        if step.inquiry is not None:
            self._asked, self._had_pose = step.inquiry, step.result is not None
            self._inquiries.put(step.inquiry)
        return [] if step.result is None else [self._placed(step.result)]

    def collect(self) -> list[PlacedResult]:
        """Take the model's findings and a waiting correction in; call it between two images.

        Raises ModelFailure, once, where it has none.
        """
        placed: list[PlacedResult] = []
        if self._asked is not None and self._findings is not None:
            asked, findings = self._asked, self._findings
            self._asked = self._findings = None
            if isinstance(findings, Exception):
                raise ModelFailure(findings, None if self._had_pose else self._pipeline.unanswered(
                    asked)) from findings
            placed = self._all_placed(self._pipeline.conclude(asked, findings))
        if self._asked is None and self._correction is not None:
            self._odometry.correct(self._pipeline.apply_correction(self._correction))
            self._correction = None
        return placed

    def correct(self, corrected: CorrectedKeyframes) -> None:
        """Take corrected poses once the model rests; a newer correction replaces an older."""
        self._correction = corrected

    def event(self, keyframe_id: int) -> KeyframeEvent:
        """A keyframe's event once more."""
        return self._pipeline.event(keyframe_id)

    def unplaced(self, result: FrameResult) -> PlacedResult:
        """A result that came about elsewhere, of an image that was of no use."""
        return self._placed(result)

    def close(self) -> None:
        """Let the model's thread end after what it is doing."""
        self._inquiries.put(None)

    def _work(self) -> None:
        while (inquiry := self._inquiries.get()) is not None:
            try:
                self._findings = self._pipeline.ask(inquiry)
            except Exception as error:      # raised again in the caller's thread
                self._findings = error
            self._on_answer()

    def _all_placed(self, result: FrameResult) -> list[PlacedResult]:
        """The result and the images placed late, in the order of their stamps."""
        again = self._had_pose
        tracked = sorted((*result.late, result), key=lambda r: r.stamp_ns)
        if self._pipeline.pieces_begun != self._pieces_begun \
                and tracked[0].T_world_cam is not None:
            self._pieces_begun = self._pipeline.pieces_begun
            self._odometry.begin_world(tracked[0].T_world_cam)
        return [self._placed(r, again=again and r is result) for r in tracked]

    def _placed(self, result: FrameResult, again: bool = False) -> PlacedResult:
        T_odom_cam = None
        if result.status is TrackingStatus.TRACKED:
            assert result.T_world_cam is not None
            T_odom_cam = self._odometry.place(result.T_world_cam)
        return PlacedResult(result, T_odom_cam, self._odometry.T_odom_world, again)
