"""The beginning of a map."""

from __future__ import annotations

from dataclasses import replace
from typing import Sequence

import clip as clips
import numpy as np
import torch
from clip import Clip

from aim_slam_ros.frontend.initialisation import Beginning, Initialisation
from aim_slam_ros.frontend.pipeline import FrontendPipeline
from aim_slam_ros.frontend.stages import Stopwatch
from aim_slam_ros.frontend.window import WindowTracker
from aim_slam_ros.models import make_model
from aim_slam_ros.models.base import GeometryModel
from aim_slam_ros.types import Frame, FrameEncoding, TrackingStatus, WindowPrediction


class OneViewModel:
    """Answers for a single view, as VGGT does: depth 2 everywhere."""

    min_views = 1

    def encode(self, frame: Frame) -> FrameEncoding:
        return FrameEncoding(frame, clips.tiny_descriptor(frame.image), None)

    def infer(self, encodings: Sequence[FrameEncoding]) -> WindowPrediction:
        frame, count = encodings[0].frame, len(encodings)
        assert frame.K is not None
        depth = torch.full((count, frame.height, frame.width), 2.0)
        return WindowPrediction(depth, torch.full(depth.shape, 5.0),
                                frame.K.expand(count, 3, 3), torch.eye(4).double().repeat(
                                    count, 1, 1))


class NoTracker:
    """A map begins without tracking."""

    def track(self, window: object) -> None:
        raise AssertionError('nothing to track yet')


def _beginner(model: GeometryModel | None = None,
              **values: object) -> tuple[Initialisation, WindowTracker]:
    config = clips.config(**values)
    window = WindowTracker(config, model or make_model(config), NoTracker())  # type: ignore
    return Initialisation(config.initialisation, config.camera, window,
                          config.keyframes.min_confident), window


def _offer(beginner: Initialisation, frames: Sequence[Frame]) -> tuple[int, Beginning | None]:
    """How many frames it took, and the beginning."""
    for count, frame in enumerate(frames, 1):
        ready = beginner.offer(frame, Stopwatch())
        beginning = beginner.begin(beginner.infer(beginner.window(), Stopwatch())) \
            if ready else None
        if beginning is not None:
            return count, beginning
    return len(frames), None


def _still(clip: Clip, count: int, index: int = 0) -> list[Frame]:
    frame = clip.frame(index)
    return [replace(frame, stamp_ns=k) for k in range(count)]


def test_a_model_that_needs_one_view_begins_at_once(clip: Clip) -> None:
    beginner, window = _beginner(OneViewModel())
    count, beginning = _offer(beginner, [clip.frame(0)])
    assert count == 1 and beginning is not None and beginning.measured
    assert len(beginning.encodings) == 1 and beginning.waiting == ()
    assert window.inferences == 1


def test_it_waits_for_parallax(clip: Clip) -> None:
    frames = [clip.frame(i) for i in range(len(clip))]
    counts = []
    for parallax in (3.0, 12.0):
        beginner, _ = _beginner(initialisation__min_parallax_px=parallax)
        count, beginning = _offer(beginner, frames)
        assert beginning is not None and beginning.measured
        assert beginning.prediction.seen_share(0) > 0.15
        counts.append(count)
    assert 2 <= counts[0] < counts[1]


def test_the_window_spans_the_wait(clip: Clip) -> None:
    """Current first, oldest second, and what lies between is handed out to be placed."""
    frames = [clip.frame(i) for i in range(len(clip))]
    count, beginning = _offer(_beginner()[0], frames)
    assert beginning is not None and count > 3
    used = [e.frame.stamp_ns for e in beginning.encodings]
    assert used[:2] == [frames[count - 1].stamp_ns, frames[0].stamp_ns]
    assert len(set(used)) == len(used) == len(beginning.prediction.depth)
    assert [f.stamp_ns for f in beginning.waiting] == clip.stamps_ns[1:count - 1]


def test_standing_still_it_begins_on_its_prior_in_the_end(clip: Clip) -> None:
    beginner, window = _beginner(initialisation__max_frames=7)
    count, beginning = _offer(beginner, _still(clip, 20))
    assert count == 7 and beginning is not None and not beginning.measured
    assert beginning.prediction.rotation_only and window.rotation_only_inferences == 1


def test_turning_is_no_parallax(clip: Clip) -> None:
    frames = [Frame(k, clips.turned(clip.images[10], clip.K, (0.0, 0.01 * k, 0.004 * k)),
                    torch.from_numpy(clip.K)) for k in range(12)]
    beginner, window = _beginner()
    _, beginning = _offer(beginner, frames)
    assert beginning is None and window.inferences == 0


def test_after_a_cut_it_begins_again(clip: Clip) -> None:
    """The first images show another place: they are left behind, not waited with."""
    before = [Frame(-9 + k, np.ascontiguousarray(clips.noise(1, (322, 238))), clip.frame(0).K)
              for k in range(3)]
    frames = [clip.frame(i) for i in range(len(clip))]
    _, beginning = _offer(_beginner()[0], [*before, *frames])
    assert beginning is not None and beginning.measured
    stamps = [e.frame.stamp_ns for e in beginning.encodings]
    stamps += [f.stamp_ns for f in beginning.waiting]
    assert min(stamps) >= frames[0].stamp_ns


def test_one_view_is_enough_for_the_whole_frontend(clip: Clip) -> None:
    pipeline = FrontendPipeline(clips.config(), OneViewModel())
    first = pipeline.process(clip.stamps_ns[0], clip.images[0], clip.K)
    assert first.status is TrackingStatus.TRACKED and len(first.events) == 1
    assert first.late == () and first.inferences == 1
    second = pipeline.process(clip.stamps_ns[1], clip.images[1], clip.K)
    assert second.status is TrackingStatus.TRACKED
