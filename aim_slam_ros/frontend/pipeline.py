"""The frontend: an image in, a pose out, keyframe events beside it (paper, Fig. 2)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Sequence

import numpy as np
from torch import Tensor

from ..config import Config
from ..geometry import sim3
from ..models.base import GeometryModel
from ..types import (CorrectedKeyframes, Frame, FrameResult, Keyframe, KeyframeEvent,
                     TrackingStatus)
from .admission import Admission
from .following import Followed, Follower
from .image_tracking import ImageTracker
from .initialisation import Beginning, Initialisation
from .inquiry import BeginningInquiry, Findings, Inquirer, Inquiry, TrackingInquiry
from .joint_tracking import JointTracker
from .keyframe_map import KeyframeMap
from .landmarks import followed_corners
from .motion import ConstantVelocity
from .promotion import Promotion
from .references import References
from .stages import Stopwatch
from .tracking import Tracker
from .window import WindowEstimate, WindowTracker

_FEWEST_SEARCHES = 3    # of the model for a lost camera, however many images pass meanwhile


@dataclass(frozen=True)
class Step:
    """How far an image came without the model.

    result: None where only the model can tell. inquiry: what it is to be asked, if anything.
    """

    result: FrameResult | None
    inquiry: Inquiry | None = None


class FrontendPipeline:
    """Tracks images in the order they come; everything it knows is in its KeyframeMap.

    ``process`` does all of it. Where the model works in a thread of its own, ``begin`` follows an
    image, ``ask`` runs in that thread, and ``conclude`` takes the findings in between two images;
    until then ``begin`` is all that may be called.
    """

    def __init__(self, config: Config, model: GeometryModel) -> None:
        self._config = config
        self._map = KeyframeMap(config.sigma)
        self._admission = Admission(config.camera)
        self._follower = Follower(config.following, followed_corners(config.following))
        self._references = References(config, self._map, self._follower)
        self._window = WindowTracker(config, model, _tracker(config))
        self._inquirer = Inquirer(config, self._map, self._window)
        self._promotion = Promotion(config.keyframes, self._map)
        self._start()

    @property
    def keyframes(self) -> tuple[Keyframe, ...]:
        """Every keyframe of every map piece, oldest first."""
        return self._map.all

    @property
    def reference_id(self) -> int:
        """The keyframe that the last image was followed against first; -1 before there is one."""
        return self._references.main_id

    @property
    def pieces_begun(self) -> int:
        """How many map pieces there have been; loop closure may have joined some since."""
        return self._map.pieces_begun

    @property
    def rotation_only_inferences(self) -> int:
        """How many inferences found a rotation without parallax."""
        return self._window.rotation_only_inferences

    def process(self, stamp_ns: int, image: np.ndarray,
                K: np.ndarray | None = None) -> FrameResult:
        """One image [H,W,3] uint8 RGB, with its intrinsics [3,3] in pixels where known."""
        step = self.begin(stamp_ns, image, K)
        if step.inquiry is not None:
            return self.conclude(step.inquiry, self.ask(step.inquiry))
        assert step.result is not None
        return step.result

    def begin(self, stamp_ns: int, image: np.ndarray, K: np.ndarray | None = None,
              may_ask: bool = True) -> Step:
        """Everything that needs no model. may_ask: no other inquiry is being worked on."""
        clock = Stopwatch()
        with clock.stage('admit'):
            frame = self._admission.admit(stamp_ns, image, K)
        if isinstance(frame, str):
            return Step(self._result(FrameResult(stamp_ns, TrackingStatus.SKIPPED, reason=frame),
                                     clock))
        if not self._map.piece:
            return self._initialise(frame, clock, may_ask)
        return self._track(frame, clock, may_ask)

    def ask(self, inquiry: Inquiry) -> Findings:
        """Let the model work; changes nothing of the map."""
        return self._inquirer.run(inquiry)

    def conclude(self, inquiry: Inquiry, findings: Findings) -> FrameResult:
        """What the findings mean for the map and their image, which may have a pose already."""
        piece_id = self._map.piece_id
        if isinstance(inquiry, BeginningInquiry):
            result = self._begin_map(inquiry, findings)
        else:
            result = self._keep_found(inquiry, findings)
        return replace(self._result(result, inquiry.clock), piece_id=piece_id,
                       inferences=findings.inferences)

    def unanswered(self, inquiry: Inquiry) -> FrameResult:
        """Instead of ``conclude`` for an image without a pose, where the model failed."""
        reason = 'the model failed'
        if isinstance(inquiry, BeginningInquiry):
            result = FrameResult(inquiry.frame.stamp_ns, TrackingStatus.INITIALISING,
                                 reason=reason)
        else:
            result = self._lost(inquiry.frame, f'{inquiry.followed.reason}; {reason}')
        return self._result(result, inquiry.clock)

    def apply_correction(self, corrected: CorrectedKeyframes) -> Tensor:
        """Take corrected keyframe poses; call between two images.

        Returns T_new_old [4,4], the Sim(3) by which the world moved where the camera is.
        """
        if not self._map.piece:
            self._map.correct(corrected)
            return sim3.identity()
        before = self._references.main.T_world_kf
        self._map.correct(corrected)
        T_new_old = self._references.main.T_world_kf @ sim3.inverse(before)
        self._motion.move_world(T_new_old)
        return T_new_old

    def event(self, keyframe_id: int) -> KeyframeEvent:
        """The event of a keyframe once more, as the keyframe is now."""
        return self._promotion.repeated_event(self._map[keyframe_id])

    def _start(self) -> None:
        """Forget where the camera is; the next images begin a map piece."""
        self._motion = ConstantVelocity()
        self._initialisation = Initialisation(
            self._config.initialisation, self._config.camera, self._window,
            self._config.keyframes.min_confident)
        self._lost_images = self._searches = 0

    def _result(self, result: FrameResult, clock: Stopwatch) -> FrameResult:
        return replace(result, piece_id=self._map.piece_id, stage_s=dict(clock.seconds))

    def _initialise(self, frame: Frame, clock: Stopwatch, may_ask: bool) -> Step:
        ready = self._initialisation.offer(frame, clock)
        if ready and may_ask:
            return Step(None, BeginningInquiry(self._initialisation.window(),
                                               self._initialisation, clock))
        reason = 'the model is busy' if ready else 'waiting for parallax'
        return Step(self._result(FrameResult(frame.stamp_ns, TrackingStatus.INITIALISING,
                                             reason=reason), clock))

    def _begin_map(self, inquiry: BeginningInquiry, findings: Findings) -> FrameResult:
        assert findings.inferred is not None
        frame = inquiry.frame
        beginning = inquiry.initialisation.begin(findings.inferred)
        if beginning is None:
            return FrameResult(frame.stamp_ns, TrackingStatus.INITIALISING,
                               reason='waiting for parallax')
        keyframes = self._promotion.begin(beginning)
        events = [self._promotion.event(k, {}, keyframes[0].keyframe_id) for k in keyframes]
        self._references.main_id = keyframes[0].keyframe_id
        late = self._place_waiting(keyframes, beginning, inquiry.clock)
        self._references.main_id = keyframes[-1].keyframe_id
        return replace(self._tracked(frame, sim3.rigid_part(keyframes[-1].T_world_kf), events),
                       late=late)

    def _place_waiting(self, keyframes: Sequence[Keyframe], beginning: Beginning,
                       clock: Stopwatch) -> tuple[FrameResult, ...]:
        """The images that the map had to wait for, followed against it now."""
        if not beginning.measured or len(keyframes) < 2:
            return ()
        first, T_world_current = keyframes[0].frame, sim3.rigid_part(keyframes[1].T_world_kf)
        late = [self._tracked(first, sim3.rigid_part(keyframes[0].T_world_kf), ())]
        for frame in beginning.waiting:
            if frame.stamp_ns > keyframes[1].stamp_ns:
                self._motion.update(keyframes[1].stamp_ns, T_world_current)
            with clock.stage('follow'):
                followed = self._follow(frame)
            if followed.ok:
                late.append(self._tracked(frame, followed.T_world_cam, ()))
        return tuple(replace(result, piece_id=self._map.piece_id) for result in late)

    def _track(self, frame: Frame, clock: Stopwatch, may_ask: bool) -> Step:
        """Follow, and say what the model should be asked."""
        with clock.stage('follow'):
            followed = self._follow(frame)
        inquiry = None
        if may_ask and self._wants_model(followed):
            inquiry = TrackingInquiry(frame, followed, self._references.main_id,
                                      self._intrinsics(frame), self._lost_images > 0, clock)
        if followed.ok:
            result = replace(self._tracked(frame, followed.T_world_cam, ()),
                             matched_fraction=followed.matched_fraction)
            return Step(self._result(result, clock), inquiry)
        if inquiry is not None:
            return Step(None, inquiry)
        return Step(self._result(self._lost(frame, f'{followed.reason}; the model is busy'),
                                 clock))

    def _keep_found(self, inquiry: TrackingInquiry, findings: Findings) -> FrameResult:
        """The pose of a frame that the model was asked about, and what is kept of it."""
        followed = inquiry.followed if findings.found is None else findings.found
        reference_id = inquiry.reference_id
        if findings.found is not None:
            reference_id = self._references.main_id = findings.found.reference_id
        T_world_cam = _pose(followed, findings.estimate)
        if T_world_cam is None:
            return self._search_failed(inquiry.frame, followed.reason)
        with inquiry.clock.stage('keep'):
            events = self._keep(inquiry, findings, followed, reference_id)
        return replace(self._tracked(inquiry.frame, T_world_cam, events),
                       matched_fraction=followed.matched_fraction,
                       **_window_facts(findings.estimate))

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

    def _keep(self, inquiry: TrackingInquiry, findings: Findings, followed: Followed,
              reference_id: int) -> list[KeyframeEvent]:
        """Fuse the window's keyframes and promote the image where it left its reference.

        The new keyframe's event is the last one.
        """
        encoding, estimate = findings.encoding, findings.estimate
        if encoding is None or estimate is None:
            return []
        self._promotion.learn(estimate)
        if followed.ok and not self._leaves_reference(followed):
            return []
        keyframe = self._promotion.promote(encoding, followed, estimate, inquiry.K)
        if keyframe is None:
            return []
        if self._references.main_id == reference_id:    # else later images found a better one
            self._references.main_id = keyframe.keyframe_id
        # What was measured is in the inference's unit; a carried pointmap is in the world's.
        measured = estimate.result.measured() if self._promotion.has_depth(estimate) else {}
        return [*self._promotion.refined(),
                self._promotion.event(keyframe, measured, reference_id)]

    def _tracked(self, frame: Frame, T_world_cam: Tensor,
                 events: Sequence[KeyframeEvent]) -> FrameResult:
        self._lost_images = self._searches = 0
        self._motion.update(frame.stamp_ns, T_world_cam)
        main = self._references.main
        T_kf_cam = sim3.with_scale(sim3.inverse(main.T_world_kf) @ T_world_cam, 1.0)
        return FrameResult(frame.stamp_ns, TrackingStatus.TRACKED, T_world_cam,
                           main.keyframe_id, T_kf_cam, events=tuple(events))

    def _lost(self, frame: Frame, reason: str) -> FrameResult:
        self._lost_images += 1
        self._motion.stop()
        return FrameResult(frame.stamp_ns, TrackingStatus.LOST, reason=reason)

    def _search_failed(self, frame: Frame, reason: str) -> FrameResult:
        """Lost, and the model could not help; after too many such images begin a new piece."""
        self._searches += 1
        result = self._lost(frame, reason)
        patience = self._config.relocalisation.give_up_after
        if self._lost_images < patience or self._searches < min(_FEWEST_SEARCHES, patience):
            return result
        self._map.begin_piece()
        self._start()
        return replace(result, reason=reason + '; a new map piece begins with the next image')


def _pose(followed: Followed, estimate: WindowEstimate | None) -> Tensor | None:
    """Rigid T_world_cam: the images' word before the model's; None where both are silent."""
    if estimate is not None and estimate.ok and estimate.result.optimised:
        return sim3.rigid_part(estimate.result.T_world_frame)
    return followed.T_world_cam if followed.ok else None


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
