"""The frontend: an image in, a pose out, keyframe events beside it (paper, Fig. 2)."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Sequence

import numpy as np
from torch import Tensor

from ..config import Config
from ..geometry import sim3
from ..models.base import GeometryModel
from ..types import (CorrectedKeyframes, Frame, FrameEncoding, FrameResult, Keyframe,
                     KeyframeEvent, TrackingStatus)
from .admission import Admission
from .following import Followed, Follower
from .image_tracking import ImageTracker
from .initialisation import Beginning, Initialisation
from .joint_tracking import JointTracker
from .keyframe_map import KeyframeMap
from .landmarks import LandmarkCache
from .motion import ConstantVelocity
from .promotion import Promotion
from .references import References
from .relocalisation import Relocalisation
from .stages import Stopwatch
from .tracking import Tracker
from .window import WindowEstimate, WindowTracker


class FrontendPipeline:
    """Tracks images in the order they come; everything it knows is in its KeyframeMap."""

    def __init__(self, config: Config, model: GeometryModel) -> None:
        self._config = config
        self._map = KeyframeMap(config.sigma)
        self._admission = Admission(config.camera)
        self._follower = Follower(config.following, LandmarkCache(config.following))
        self._references = References(config, self._map, self._follower)
        self._window = WindowTracker(config, model, _tracker(config))
        self._relocalisation = Relocalisation(config, self._map, self._follower, self._window)
        self._promotion = Promotion(config.keyframes, self._map)
        self._start()

    @property
    def keyframes(self) -> tuple[Keyframe, ...]:
        """Every keyframe of every map piece, oldest first."""
        return self._map.all

    @property
    def rotation_only_inferences(self) -> int:
        """How many inferences found a rotation without parallax."""
        return self._window.rotation_only_inferences

    def process(self, stamp_ns: int, image: np.ndarray,
                K: np.ndarray | None = None) -> FrameResult:
        """One image [H,W,3] uint8 RGB, with its intrinsics [3,3] in pixels where known."""
        clock = Stopwatch()
        inferences, piece_id = self._window.inferences, self._map.piece_id
        with clock.stage('admit'):
            frame = self._admission.admit(stamp_ns, image, K)
        if isinstance(frame, str):
            result = FrameResult(stamp_ns, TrackingStatus.SKIPPED, reason=frame)
        elif not self._map.piece:
            result = self._initialise(frame, clock)
        else:
            result = self._track(frame, clock)
        return replace(result, piece_id=piece_id, stage_s=clock.seconds,
                       inferences=self._window.inferences - inferences)

    def apply_correction(self, corrected: CorrectedKeyframes) -> None:
        """Take corrected keyframe poses; call between two images."""
        if not self._map.piece:
            self._map.correct(corrected)
            return
        before = self._references.main.T_world_kf
        self._map.correct(corrected)
        self._motion.move_world(self._references.main.T_world_kf @ sim3.inverse(before))

    def _start(self) -> None:
        """Forget where the camera is; the next images begin a map piece."""
        self._motion = ConstantVelocity()
        self._initialisation = Initialisation(
            self._config.initialisation, self._config.camera, self._window,
            self._config.keyframes.min_confident)
        self._lost_images = 0

    def _initialise(self, frame: Frame, clock: Stopwatch) -> FrameResult:
        beginning = self._initialisation.offer(frame, clock)
        if beginning is None:
            return FrameResult(frame.stamp_ns, TrackingStatus.INITIALISING,
                               reason='waiting for parallax')
        keyframes = self._promotion.begin(beginning)
        events = [self._promotion.event(k, {}, keyframes[0].keyframe_id) for k in keyframes]
        self._references.main_id = keyframes[0].keyframe_id
        late = self._place_waiting(keyframes, beginning, clock)
        self._references.main_id = keyframes[-1].keyframe_id
        return replace(self._tracked(frame, sim3.rigid_part(keyframes[-1].T_world_kf), events),
                       late=late)

    def _place_waiting(self, keyframes: Sequence[Keyframe], beginning: Beginning,
                       clock: Stopwatch) -> tuple[FrameResult, ...]:
        """The images that the map had to wait for, followed against it now."""
        if not beginning.measured or len(keyframes) < 2:
            return ()
        first = keyframes[0].frame
        late = [self._tracked(first, sim3.rigid_part(keyframes[0].T_world_kf), ())]
        for frame in beginning.waiting:
            with clock.stage('follow'):
                followed = self._follow(frame)
            if followed.ok:
                late.append(self._tracked(frame, followed.T_world_cam, ()))
        return tuple(replace(result, piece_id=self._map.piece_id) for result in late)

    def _track(self, frame: Frame, clock: Stopwatch) -> FrameResult:
        """Follow, ask the model where it pays, keep what came of it."""
        with clock.stage('follow'):
            followed = self._follow(frame)
        encoding, estimate = None, None
        if self._wants_model(followed):
            encoding = self._window.encode(frame, clock)
            if not followed.ok and self._lost_images:
                followed = self._relocalise(encoding, followed, clock)
            if followed.ok or not self._lost_images:
                estimate = self._window.track(
                    encoding, followed.T_world_cam if followed.ok else None,
                    self._references.main_id, self._map, clock)
        T_world_cam = self._pose(followed, estimate)
        if T_world_cam is None:
            return self._lost(frame, followed.reason)
        with clock.stage('keep'):
            events = self._keep(encoding, followed, estimate)
        return replace(self._tracked(frame, T_world_cam, events),
                       matched_fraction=followed.matched_fraction, **_window_facts(estimate))

    def _intrinsics(self, frame: Frame) -> Tensor:
        return frame.K if frame.K is not None else self._references.main.K

    def _follow(self, frame: Frame) -> Followed:
        """The image against the references; where it sees little of them, against older ones."""
        K, T_world_cam = self._intrinsics(frame), self._motion.predict(frame.stamp_ns)
        followed = self._follower.follow(frame.grey, K, T_world_cam,
                                         self._references.near(T_world_cam))
        if not followed.ok:
            T_world_cam = self._motion.T_world_cam   # a jerk: perhaps it stands still
            followed = self._follower.follow(frame.grey, K, T_world_cam,
                                             self._references.near(T_world_cam))
        if followed.ok and self._leaves_reference(followed):
            followed = self._references.reuse(frame.grey, K, followed)
        return followed

    def _leaves_reference(self, followed: Followed) -> bool:
        return followed.matched_fraction < self._config.keyframes.promote_below

    def _wants_model(self, followed: Followed) -> bool:
        return (self._config.model.infer == 'every_image' or not followed.ok
                or self._leaves_reference(followed))

    def _relocalise(self, encoding: FrameEncoding, followed: Followed,
                    clock: Stopwatch) -> Followed:
        found = self._relocalisation.find(encoding, self._intrinsics(encoding.frame), clock)
        if found is None:
            return followed
        self._references.main_id = next(iter(found.fractions))
        return found

    def _pose(self, followed: Followed, estimate: WindowEstimate | None) -> Tensor | None:
        """Rigid T_world_cam: the images' word before the model's; None where both are silent."""
        if estimate is not None and estimate.ok and math.isfinite(estimate.kappa):
            return sim3.rigid_part(estimate.result.T_world_frame)
        return followed.T_world_cam if followed.ok else None

    def _keep(self, encoding: FrameEncoding | None, followed: Followed,
              estimate: WindowEstimate | None) -> list[KeyframeEvent]:
        """Fuse the window's keyframes and promote the image where it left its reference."""
        if encoding is None or estimate is None:
            return []
        self._promotion.learn(estimate)
        if followed.ok and not self._leaves_reference(followed):
            return []
        keyframe = self._promotion.promote(encoding, followed, estimate,
                                           self._intrinsics(encoding.frame))
        if keyframe is None:
            return []
        before, self._references.main_id = self._references.main_id, keyframe.keyframe_id
        # What was measured is in the inference's unit; a carried pointmap is in the world's.
        measured = estimate.result.measured if self._promotion.has_depth(estimate) else {}
        return [self._promotion.event(keyframe, measured, before)]

    def _tracked(self, frame: Frame, T_world_cam: Tensor,
                 events: Sequence[KeyframeEvent]) -> FrameResult:
        self._lost_images = 0
        self._motion.update(frame.stamp_ns, T_world_cam)
        main = self._references.main
        T_kf_cam = sim3.with_scale(sim3.inverse(main.T_world_kf) @ T_world_cam, 1.0)
        return FrameResult(frame.stamp_ns, TrackingStatus.TRACKED, T_world_cam,
                           main.keyframe_id, T_kf_cam, events=tuple(events))

    def _lost(self, frame: Frame, reason: str) -> FrameResult:
        """Count it; after too many begin a new map piece."""
        self._lost_images += 1
        self._motion.stop()
        if self._lost_images >= self._config.relocalisation.give_up_after:
            self._map.begin_piece()
            self._start()
            reason += '; a new map piece begins with the next image'
        return FrameResult(frame.stamp_ns, TrackingStatus.LOST, reason=reason)


def _tracker(config: Config) -> Tracker:
    if config.tracking.tracker == 'paper':
        return JointTracker(config.joint_tracking)
    return ImageTracker(config.tracking, config.following, config.keyframes.min_confident)


def _window_facts(estimate: WindowEstimate | None) -> dict[str, Any]:
    """What a FrameResult says about the inference."""
    if estimate is None:
        return {}
    return {'window': tuple(k.keyframe_id for k in estimate.keyframes),
            'kappa': estimate.kappa if math.isfinite(estimate.kappa) else None}
