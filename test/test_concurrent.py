"""The frontend whose model has its own thread, and the odom frame that never jumps."""

from __future__ import annotations

import threading
from typing import Sequence

import clip as clips
import numpy as np
import pytest
import torch
from clip import Clip
from room_walk import ate
from torch import Tensor

from aim_slam_ros.frontend.concurrent import ConcurrentFrontend, ModelFailure, PlacedResult
from aim_slam_ros.frontend.odometry import OdometryFrame
from aim_slam_ros.geometry import sim3
from aim_slam_ros.models import make_model
from aim_slam_ros.models.base import GeometryModel
from aim_slam_ros.types import (CorrectedKeyframes, Frame, FrameEncoding, KeyframePose,
                                TrackingStatus, WindowPrediction)

TRACKED = TrackingStatus.TRACKED


class Gate:
    """A real model that answers when it is let: how slow it is does not depend on the machine."""

    def __init__(self, model: GeometryModel) -> None:
        self.min_views = model.min_views
        self.open = threading.Event()
        self.open.set()
        self.broken = False
        self._model = model

    def encode(self, frame: Frame) -> FrameEncoding:
        return self._model.encode(frame)

    def infer(self, encodings: Sequence[FrameEncoding]) -> WindowPrediction:
        assert self.open.wait(timeout=20.0)
        if self.broken:
            raise RuntimeError('out of memory')
        return self._model.infer(encodings)


class Run:
    """A frontend over the clip, and what came of it."""

    def __init__(self, clip: Clip, **values: object) -> None:
        config = clips.config(**values)
        self.clip = clip
        self.gate = Gate(make_model(config))
        self.answered = threading.Semaphore(0)
        self.frontend = ConcurrentFrontend(config, self.gate, self.answered.release)
        self.placed: list[PlacedResult] = []

    def feed(self, index: int, wait: bool = True) -> list[PlacedResult]:
        """One image; wait: for the model too, where it was asked."""
        new = self.frontend.collect()
        new += self.frontend.process(self.clip.stamps_ns[index], self.clip.images[index],
                                     self.clip.K)
        if wait and self.frontend.busy:
            new += self.answer()
        self.placed += new
        return new

    def answer(self) -> list[PlacedResult]:
        assert self.answered.acquire(timeout=20.0)
        return self.frontend.collect()

    def poses(self) -> dict[int, Tensor]:
        return {p.result.stamp_ns: p.T_odom_cam for p in self.placed
                if p.T_odom_cam is not None and not p.again}


def _ate(poses: dict[int, Tensor], clip: Clip) -> float:
    index = [clip.stamps_ns.index(stamp) for stamp in poses]
    return ate(torch.stack(list(poses.values())), clip.T_world_cam[index])


def test_with_a_quick_model_it_is_the_frontend(clip: Clip) -> None:
    run = Run(clip)
    for index in range(len(clip)):
        run.feed(index)
    poses = run.poses()
    assert list(poses) == sorted(poses), 'late ones before those that follow'
    assert len(poses) >= 0.9 * len(clip)
    assert _ate(poses, clip) < 0.05, 'metres, as of the frontend itself (test_pipeline)'


def test_a_pose_for_every_image_while_the_model_works(clip: Clip) -> None:
    run = Run(clip, keyframes__promote_below=0.9)
    index = 0
    while not run.poses():
        run.feed(index)
        index += 1
    run.gate.open.clear()
    during = [run.feed(i, wait=False) for i in range(index, index + 8)]
    assert run.frontend.busy
    statuses = [p.result.status for results in during for p in results]
    assert statuses == [TRACKED] * 8
    before = len(run.frontend.pipeline.keyframes)
    run.gate.open.set()
    (again,) = run.answer()
    assert again.again and again.result.events and again.result.inferences > 0
    assert len(run.frontend.pipeline.keyframes) == before + 1
    asked_at = again.result.stamp_ns
    assert asked_at in [p.result.stamp_ns for results in during[:7] for p in results]
    (following,) = run.feed(index + 8)[:1]
    assert following.result.status is TRACKED


def test_a_map_that_begins_slowly_loses_no_image(clip: Clip) -> None:
    """Images that pass while the first inference goes on are placed when it is done."""
    run, index, passed = Run(clip), 0, range(0)
    while not run.poses():      # the first answers may be that it is too early
        run.gate.open.clear()
        while not run.frontend.busy:
            run.feed(index, wait=False)
            index += 1
        passed = range(index, index + 2)
        for index in passed:
            (waits,) = run.feed(index, wait=False)
            assert waits.result.status is TrackingStatus.INITIALISING
        index += 1
        run.gate.open.set()
        run.placed += run.answer()
    stamps = list(run.poses())
    assert stamps == sorted(stamps)
    assert {clip.stamps_ns[i] for i in passed} <= set(stamps)
    assert _ate(run.poses(), clip) < 0.05


def test_a_correction_waits_for_the_model_and_odometry_does_not_jump(clip: Clip) -> None:
    run = Run(clip, keyframes__promote_below=0.9)
    index = 0
    while len(run.poses()) < 6:
        run.feed(index)
        index += 1
    pipeline = run.frontend.pipeline
    a, b = list(run.poses().values())[-2:]
    step = float((b - a)[:3, 3].norm())
    run.gate.open.clear()
    while not run.frontend.busy:
        run.feed(index, wait=False)
        index += 1
    old = {k.keyframe_id: k.T_world_kf for k in pipeline.keyframes}
    T_new_old = sim3.exp(torch.tensor([2.0, -1.0, 0.5, 0.3, 0.2, 0.1, 0.4], dtype=torch.float64))
    run.frontend.correct(CorrectedKeyframes(1, tuple(
        KeyframePose(k, T_new_old @ T) for k, T in old.items())))
    run.feed(index, wait=False)
    assert all(torch.equal(k.T_world_kf, old[k.keyframe_id]) for k in pipeline.keyframes)
    run.gate.open.set()
    run.placed += run.answer()
    for k in pipeline.keyframes:
        if k.keyframe_id in old:
            torch.testing.assert_close(k.T_world_kf, T_new_old @ old[k.keyframe_id])
    before = list(run.poses().values())[-1]
    after = run.feed(index + 1)[0]
    assert after.T_odom_cam is not None and not after.again
    jump = float((after.T_odom_cam - before)[:3, 3].norm())
    assert jump < 4.0 * max(step, 0.02), 'a step or two of the camera; the world moved by 2.3'
    assert _ate(run.poses(), clip) < 0.05, 'and the scale stays, though the world grew by half'


def test_what_the_model_raises_reaches_the_caller_once(clip: Clip) -> None:
    run = Run(clip)
    run.gate.broken = True
    index = 0
    while not run.frontend.busy:
        run.feed(index, wait=False)
        index += 1
    with pytest.raises(ModelFailure, match='RuntimeError: out of memory') as failure:
        run.answer()
    assert failure.value.result is not None, 'or the image would never be answered'
    assert failure.value.result.stamp_ns == clip.stamps_ns[index - 1]
    assert failure.value.result.status is TrackingStatus.INITIALISING
    assert run.frontend.collect() == []
    run.gate.broken = False
    for later in range(index, len(clip)):
        run.feed(later)
    assert len(run.poses()) > 0.5 * len(clip), 'it goes on'


def test_a_camera_that_is_lost_while_the_model_fails_is_found_again(clip: Clip) -> None:
    run, index = Run(clip), 0
    while not run.poses():
        run.feed(index)
        index += 1
    run.gate.broken = True
    black = clip.images[index] // 40 + np.random.default_rng(0).integers(
        0, 60, clip.images[index].shape, np.uint8)
    for k in range(3):
        assert run.frontend.process(clip.stamps_ns[index] + k, black, clip.K) == []
        with pytest.raises(ModelFailure) as failure:
            run.answer()
        assert failure.value.result is not None
        assert failure.value.result.status is TrackingStatus.LOST
        assert failure.value.result.reason.endswith('the model failed')
    run.gate.broken = False
    (placed,) = run.feed(index + 1)[:1]
    assert placed.result.status is TRACKED


def test_another_world_begins_where_the_camera_was() -> None:
    frame = OdometryFrame()
    here = sim3.exp(torch.tensor([1.0, 2.0, 3.0, 0.1, 0.2, 0.3, 0.0], dtype=torch.float64))
    torch.testing.assert_close(frame.place(here), here)    # the first world is the odom frame
    frame.begin_world(sim3.identity())
    torch.testing.assert_close(frame.place(sim3.identity()), here)
    step = sim3.exp(torch.tensor([0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64))
    torch.testing.assert_close(frame.place(step), here @ step)
