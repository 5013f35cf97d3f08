"""SIGMA, inference and tracking of one image: the paper's loop around the model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Sequence

from torch import Tensor

from ..config import Config
from ..devices import chosen_device
from ..models.base import GeometryModel
from ..types import Frame, FrameEncoding, Keyframe, WindowPrediction
from .alignment import observed
from .keyframe_map import KeyframeMap
from .merging import merged
from .prioritisation import make_prioritiser
from .shared_focal import SharedFocal
from .sigma import activate
from .stages import Stopwatch
from .tracking import Tracker, TrackingResult, TrackingWindow


@dataclass(frozen=True)
class WindowEstimate:
    """One inference over a window and the pose it led to."""

    keyframes: tuple[Keyframe, ...]
    prediction: WindowPrediction
    result: TrackingResult

    @property
    def ok(self) -> bool:
        return self.result.ok

    @property
    def kappa(self) -> float:
        return self.result.kappa


class WindowTracker:
    """Prioritises keyframes, infers, tracks, and adds keyframes while that helps.

    The only place that asks the model, so that every inference is counted, and brought to the
    device that pointmaps are kept on. Raises ConfigError where that is not there.
    """

    def __init__(self, config: Config, model: GeometryModel, tracker: Tracker) -> None:
        self._config = config.sigma
        self._prioritiser = make_prioritiser(config.sigma)
        self._fusion = config.keyframes
        self._model = model
        self._tracker = tracker
        self._device = chosen_device('keyframes.device', config.keyframes.device)
        self._focal = SharedFocal(config.keyframes)
        self.inferences = 0
        self.rotation_only_inferences = 0

    @property
    def min_views(self) -> int:
        return self._model.min_views

    def encode(self, frame: Frame, clock: Stopwatch) -> FrameEncoding:
        with clock.stage('encode'):
            return self._model.encode(frame)

    def infer(self, encodings: Sequence[FrameEncoding], clock: Stopwatch) -> WindowPrediction:
        """One inference, counted and timed, with the camera's focal length."""
        with clock.stage('infer'):
            prediction = self._model.infer(encodings).to(self._device)
        prediction = self._focal.applied(prediction, encodings[0].frame)
        self.inferences += 1
        self.rotation_only_inferences += prediction.rotation_only
        return prediction

    def track(self, encoding: FrameEncoding, guess: Tensor | None, reference_id: int,
              keyframes: KeyframeMap, clock: Stopwatch) -> WindowEstimate:
        """The window is chosen around the reference keyframe (paper: the last keyframe)."""
        with clock.stage('prioritise'):
            ranked = self._prioritiser.ranked(keyframes[reference_id], keyframes)
        return activate(
            reference_id, ranked,
            lambda ids, before: self.estimate(encoding, guess, [keyframes[i] for i in ids],
                                              clock, before),
            lambda estimate, ids: self._reorder(estimate, [keyframes[i] for i in ids], clock),
            self._config).attempt

    def _reorder(self, estimate: WindowEstimate, remaining: Sequence[Keyframe],
                 clock: Stopwatch) -> tuple[int, ...]:
        """The remaining candidates ranked again, the reference as this estimate would leave it."""
        with clock.stage('prioritise'):
            reference = observed(estimate.keyframes[0], estimate.prediction, 1, self._fusion)
            return self._prioritiser.reranked(reference, remaining)

    def estimate(self, encoding: FrameEncoding, guess: Tensor | None,
                 keyframes: Sequence[Keyframe], clock: Stopwatch,
                 narrower: WindowEstimate | None = None) -> WindowEstimate:
        """One inference over the image and these keyframes, and its pose.

        narrower: an estimate with the first of these keyframes, that this one adds to.
        """
        prediction = self.infer([encoding, *(k.encoding for k in keyframes)], clock)
        if narrower is not None:
            prediction = merged(prediction, narrower.prediction)
        with clock.stage('track'):
            result = self._tracker.track(
                TrackingWindow(encoding.frame, prediction, tuple(keyframes), guess))
        return WindowEstimate(tuple(keyframes), prediction, result)
