"""What the geometry model's own poses give, without SLAM: frontends to compare with.

Neither follows images, optimises, fuses, recognises old places nor recovers from a loss.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import Callable, Protocol, Sequence

import numpy as np
import torch
from torch import Tensor

from aim_slam_ros.config import Config, SigmaConfig
from aim_slam_ros.frontend.admission import Admission
from aim_slam_ros.frontend.alignment import pose_mean
from aim_slam_ros.frontend.keyframe_map import KeyframeMap
from aim_slam_ros.frontend.prioritisation import make_prioritiser
from aim_slam_ros.frontend.stages import Stopwatch
from aim_slam_ros.frontend.tracking import TrackingWindow
from aim_slam_ros.geometry import camera, sim3
from aim_slam_ros.models.base import GeometryModel
from aim_slam_ros.types import (GUESSED_CONFIDENCE, CorrectedKeyframes, Frame, FrameEncoding,
                                FrameResult, Keyframe, KeyframeEvent, TrackingStatus,
                                WindowPrediction)

_NOT_KEPT = -1
_GRID = 8   # every so many pixels of a keyframe tell how much of it is still seen

# T_world_frame of a window, Sim(3) [4,4], or None; the second argument is the smallest share of a
# view that the model must have seen for it to have a say.
Placing = Callable[[TrackingWindow, float], Tensor | None]


def chained(config: Config, model: GeometryModel) -> ModelOdometry:
    """Every image hangs on the one before, in a window of the newest images.

    Their relative pose is the model's; the scale is what brings the earlier image's depth in this
    window to its depth in the window before.
    """
    return ModelOdometry(config, model, RecentImages(config.sigma), _by_newest)


def averaged(config: Config, model: GeometryModel) -> ModelOdometry:
    """The mean of where the keyframes of the window place the image, each with its own scale."""
    return ModelOdometry(config, model, ChosenKeyframes(config.sigma), pose_mean)


def _by_newest(window: TrackingWindow, min_seen: float) -> Tensor | None:
    return pose_mean(replace(window, keyframes=window.keyframes[:1]), min_seen)


class Companions(Protocol):
    """With which older views an image is shown to the model."""

    def of_next(self, keyframes: KeyframeMap) -> tuple[Keyframe, ...]:
        """The newest first; ``sigma.max_window`` - 1 of them where there are so many."""

    def add(self, view: Keyframe) -> None:
        """An image that was placed, as if it were a keyframe."""


class RecentImages:
    """The newest images, keyframes or not."""

    def __init__(self, config: SigmaConfig) -> None:
        self._views: deque[Keyframe] = deque(maxlen=config.max_window - 1)

    def of_next(self, keyframes: KeyframeMap) -> tuple[Keyframe, ...]:
        return tuple(self._views)

    def add(self, view: Keyframe) -> None:
        self._views.appendleft(view)


class ChosenKeyframes:
    """The newest keyframe and others as ``sigma.prioritiser`` orders them."""

    def __init__(self, config: SigmaConfig) -> None:
        self._prioritiser = make_prioritiser(config)
        self._others = config.max_window - 2

    def of_next(self, keyframes: KeyframeMap) -> tuple[Keyframe, ...]:
        newest = keyframes.piece[-1]
        ids = self._prioritiser.ranked(newest, keyframes)[:self._others]
        return (newest, *(keyframes[i] for i in ids))

    def add(self, view: Keyframe) -> None:
        """Images that are no keyframes do not count."""


class ModelOdometry:
    """A frontend that asks the model about every image, in full windows, and believes it.

    An image that sees less than ``keyframes.promote_below`` of the newest keyframe is the next.
    """

    def __init__(self, config: Config, model: GeometryModel, companions: Companions,
                 place: Placing) -> None:
        self._config = config
        self._model = model
        self._companions = companions
        self._place = place
        self._admission = Admission(config.camera)
        self._map = KeyframeMap(config.sigma)
        self._first: FrameEncoding | None = None
        self.rotation_only_inferences = 0

    @property
    def keyframes(self) -> tuple[Keyframe, ...]:
        return self._map.all

    def process(self, stamp_ns: int, image: np.ndarray,
                K: np.ndarray | None = None) -> FrameResult:
        """One image [H,W,3] uint8 RGB, with its intrinsics [3,3] where known."""
        clock = Stopwatch()
        frame = self._admission.admit(stamp_ns, image, K)
        if isinstance(frame, str):
            return FrameResult(stamp_ns, TrackingStatus.SKIPPED, reason=frame)
        with clock.stage('encode'):
            encoding = self._model.encode(frame)
        result = self._track(encoding, clock) if self.keyframes else self._begin(encoding, clock)
        return replace(result, stage_s=dict(clock.seconds))

    def apply_correction(self, corrected: CorrectedKeyframes) -> Tensor:
        """Take corrected keyframe poses; the frame that follows is placed by them."""
        self._map.correct(corrected)
        return sim3.identity()

    def _begin(self, encoding: FrameEncoding, clock: Stopwatch) -> FrameResult:
        """The first image is the world; where one view is too few, once a second connects."""
        stamp_ns = encoding.frame.stamp_ns
        if self._first is None and self._model.min_views > 1:
            self._first = encoding
            return FrameResult(stamp_ns, TrackingStatus.INITIALISING, reason='one view is too few')
        views = [encoding] if self._first is None else [encoding, self._first]
        prediction = self._infer(views, clock)
        if prediction.rotation_only or not self._seen(prediction, -1):
            return FrameResult(stamp_ns, TrackingStatus.INITIALISING, inferences=1,
                               reason='the model measured no depth')
        first = self._keep(_view(views[-1], prediction, -1, sim3.identity()))
        self._companions.add(first)
        T_world_frame = sim3.inverse(prediction.T_first_cam[-1])
        if self._first is not None and self._seen(prediction, 0):
            self._companions.add(_view(encoding, prediction, 0, T_world_frame))
        return replace(self._tracked(encoding.frame, first, T_world_frame), inferences=1,
                       events=(_event(first),))

    def _track(self, encoding: FrameEncoding, clock: Stopwatch) -> FrameResult:
        with clock.stage('prioritise'):
            others = self._companions.of_next(self._map)
        prediction = self._infer([encoding, *(k.encoding for k in others)], clock)
        with clock.stage('track'):
            T_world_frame = self._place(TrackingWindow(encoding.frame, prediction, others),
                                        self._config.keyframes.min_confident)
        window = tuple(keyframe.keyframe_id for keyframe in others)
        if T_world_frame is None:
            return FrameResult(encoding.frame.stamp_ns, TrackingStatus.LOST, window=window,
                               inferences=1, reason='the model did not connect the image')
        result = replace(self._tracked(encoding.frame, self.keyframes[-1], T_world_frame),
                         window=window, inferences=1)
        if prediction.rotation_only or not self._seen(prediction, 0):
            return result
        return self._learned(result, _view(encoding, prediction, 0, T_world_frame))

    def _learned(self, result: FrameResult, view: Keyframe) -> FrameResult:
        """The result with a keyframe event where the image left the newest keyframe."""
        self._companions.add(view)
        seen = _still_seen(self.keyframes[-1], view, self._config.sigma.depth_tolerance)
        result = replace(result, matched_fraction=seen)
        if seen >= self._config.keyframes.promote_below:
            return result
        return replace(result, events=(_event(self._keep(view)),))

    def _infer(self, encodings: Sequence[FrameEncoding], clock: Stopwatch) -> WindowPrediction:
        with clock.stage('infer'):
            prediction = self._model.infer(encodings)
        self.rotation_only_inferences += prediction.rotation_only
        return prediction

    def _seen(self, prediction: WindowPrediction, view: int) -> bool:
        return prediction.seen_share(view) >= self._config.keyframes.min_confident

    def _keep(self, view: Keyframe) -> Keyframe:
        return self._map.add(view.encoding, view.K, view.points_cam, view.confidence,
                             view.T_world_kf)

    def _tracked(self, frame: Frame, reference: Keyframe, T_world_frame: Tensor) -> FrameResult:
        T_kf_cam = sim3.with_scale(sim3.inverse(reference.T_world_kf) @ T_world_frame, 1.0)
        return FrameResult(frame.stamp_ns, TrackingStatus.TRACKED, sim3.rigid_part(T_world_frame),
                           reference.keyframe_id, T_kf_cam)


def _view(encoding: FrameEncoding, prediction: WindowPrediction, view: int,
          T_world_view: Tensor) -> Keyframe:
    """One view of an inference; its id says that it is not in the map."""
    points = camera.unproject(prediction.depth[view], prediction.K[view])
    return Keyframe(_NOT_KEPT, 0, encoding, prediction.K[view], points,
                    prediction.confidence[view], T_world_view)


def _still_seen(keyframe: Keyframe, view: Keyframe, tolerance: float) -> float:
    """Share of what the keyframe saw that the view sees, at the same depth.

    tolerance: of the log depth, above which something else stands there.
    """
    seen = keyframe.confidence[::_GRID, ::_GRID] > GUESSED_CONFIDENCE
    own = keyframe.points_cam[::_GRID, ::_GRID][seen].double()
    points = sim3.transform(sim3.inverse(view.T_world_kf) @ keyframe.T_world_kf, own)
    uv = camera.project(points, view.K)
    inside = camera.inside(uv, *view.confidence.shape)
    u, v = uv[inside].round().long().unbind(-1)
    gap = torch.log(points[inside, 2] / view.points_cam[v, u, 2]).abs()
    return int((gap < tolerance).sum()) / max(len(own), 1)


def _event(keyframe: Keyframe) -> KeyframeEvent:
    """Without edges: nothing was measured but what the pose says already."""
    return KeyframeEvent(
        keyframe.keyframe_id, keyframe.piece_id, keyframe.stamp_ns, keyframe.frame.image,
        keyframe.K, keyframe.points_cam, keyframe.confidence, keyframe.T_world_kf,
        keyframe.encoding.descriptor)
