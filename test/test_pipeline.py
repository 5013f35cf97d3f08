"""The frontend as its user sees it: images in, poses out, whatever the images are."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Iterable

import clip as clips
import numpy as np
import pytest
import room_walk
import torch
from clip import Clip
from torch import Tensor

from aim_slam_ros.config import Config
from aim_slam_ros.datasets import load_sequence
from aim_slam_ros.frontend.pipeline import FrontendPipeline
from aim_slam_ros.geometry import sim3
from aim_slam_ros.models import make_model
from aim_slam_ros.types import (CorrectedKeyframes, FrameResult, KeyframeEvent, KeyframePose,
                                TrackingStatus)

DATA = Path(__file__).resolve().parents[2] / 'shared/data'
TRACKED, LOST = TrackingStatus.TRACKED, TrackingStatus.LOST
SKIPPED, INITIALISING = TrackingStatus.SKIPPED, TrackingStatus.INITIALISING
BEGUN = 16      # of the clip's images: by then the map has begun


def _pipeline(config: Config | None = None) -> FrontendPipeline:
    config = config or clips.config()
    return FrontendPipeline(config, make_model(config))


def _feed(pipeline: FrontendPipeline, clip: Clip, indices: Iterable[int],
          later_ns: int = 0) -> list[FrameResult]:
    return [pipeline.process(clip.stamps_ns[i] + later_ns, clip.images[i], clip.K)
            for i in indices]


def _poses(results: Iterable[FrameResult]) -> dict[int, Tensor]:
    """Every pose by stamp, late ones included."""
    return {r.stamp_ns: r.T_world_cam for result in results for r in (*result.late, result)
            if r.T_world_cam is not None}


def _depth_in_world(event: KeyframeEvent) -> float:
    """The median; a keyframe's unit may be that of an inference or the world's."""
    return float(sim3.scale_of(event.T_world_kf) * event.points_cam[..., 2].median())


def _ate(poses: dict[int, Tensor], clip: Clip, later_ns: int = 0) -> float:
    """Metres, after a similarity alignment."""
    index = [clip.stamps_ns.index(stamp - later_ns) for stamp in poses]
    return room_walk.ate(torch.stack(list(poses.values())), clip.T_world_cam[index])


def _unit(poses: dict[int, Tensor], clip: Clip) -> float:
    """Metres per map unit, by the length of the path."""
    index = [clip.stamps_ns.index(stamp) for stamp in poses]
    path, truth = (torch.stack(list(T))[:, :3, 3].diff(dim=0).norm(dim=1).sum()
                   for T in (poses.values(), clip.T_world_cam[index]))
    return float(truth / path)


def _edges_fit(pipeline: FrontendPipeline, results: Iterable[FrameResult]) -> None:
    """Each keyframe's edges say much the same as the poses it was added with."""
    T_world = {k.keyframe_id: k.T_world_kf for k in pipeline.keyframes}
    for event in (e for r in results for e in r.events):
        for edge in event.edges:
            T = sim3.inverse(T_world[edge.a]) @ T_world[edge.b]
            assert sim3.angle_rad(edge.T_a_b, T) < 0.05
            ratio = float(sim3.scale_of(edge.T_a_b) / sim3.scale_of(T))
            assert ratio == pytest.approx(1.0, abs=0.2), (edge.a, edge.b)


def _sane(results: Iterable[FrameResult]) -> None:
    """What holds for every answer."""
    for r in results:
        assert (r.T_world_cam is not None) == (r.status is TRACKED)
        assert (r.reason != '') == (r.status is not TRACKED), r
        if r.T_world_cam is None:
            continue
        assert bool(torch.isfinite(r.T_world_cam).all())
        R = r.T_world_cam[:3, :3]
        assert torch.allclose(R @ R.T, torch.eye(3).double(), atol=1e-6), 'rigid'
        assert r.reference_id is not None and r.T_kf_cam is not None


@pytest.fixture(scope='module')
def run(clip: Clip) -> list[FrameResult]:
    return _feed(_pipeline(), clip, range(len(clip)))


class TestTracking:
    def test_every_image_gets_its_pose(self, clip: Clip, run: list[FrameResult]) -> None:
        _sane(run)
        poses = _poses(run)
        assert list(poses) == clip.stamps_ns, 'also those that waited, in order'
        assert _ate(poses, clip) < 0.05     # metres, on a path of some 3 m at 3 m depth

    def test_images_that_waited_are_placed_when_the_map_begins(
            self, clip: Clip, run: list[FrameResult]) -> None:
        waiting = [r for r in run if r.status is INITIALISING]
        begun = run[len(waiting)]
        assert [r.stamp_ns for r in begun.late] == [r.stamp_ns for r in waiting]
        assert len(waiting) > 2 and all(r.late == () for r in run if r is not begun)
        _sane(begun.late)
        assert {r.piece_id for r in begun.late} == {begun.piece_id}
        assert len(begun.events) == 2

    def test_keyframes_come_as_events_with_edges(self, run: list[FrameResult]) -> None:
        events = [e for r in run for e in r.events if e.observations == 1]
        assert [e.keyframe_id for e in events] == list(range(len(events))) and len(events) > 2
        for event in events:
            older = {edge.a for edge in event.edges}
            assert all(edge.b == event.keyframe_id for edge in event.edges)
            assert older <= set(range(event.keyframe_id))
            assert older or event.keyframe_id == 0

    def test_a_keyframe_known_much_better_is_told_again_beside_a_new_one(
            self, run: list[FrameResult]) -> None:
        known: dict[int, int] = {}
        for result in run:
            for event in result.events:
                before = known.get(event.keyframe_id, 0)
                assert event.observations >= 3 * before
                known[event.keyframe_id] = event.observations
            assert not result.events or result.events[-1].observations == 1, 'the new one is last'
        assert max(known.values()) >= 3

    def test_edges_agree_with_the_map(self, clip: Clip) -> None:
        pipeline = _pipeline()
        _edges_fit(pipeline, _feed(pipeline, clip, range(30)))

    def test_pose_and_reference_agree(self, clip: Clip, run: list[FrameResult]) -> None:
        pipeline = _pipeline()
        for result in _feed(pipeline, clip, range(BEGUN)):
            if result.reference_id is None or result.T_world_cam is None:
                continue
            T_world_kf = pipeline.keyframes[result.reference_id].T_world_kf
            assert result.T_kf_cam is not None
            assert torch.allclose(sim3.rigid_part(T_world_kf @ result.T_kf_cam),
                                  result.T_world_cam, atol=1e-6)

    def test_two_runs_are_the_same(self, clip: Clip, run: list[FrameResult]) -> None:
        again = _poses(_feed(_pipeline(), clip, range(30)))
        before = _poses(run)
        assert len(again) == 30
        for stamp, T in again.items():
            assert torch.equal(before[stamp], T), clip.stamps_ns.index(stamp)

    def test_costs_are_told(self, run: list[FrameResult]) -> None:
        assert {'admit', 'follow', 'encode', 'infer', 'keep'} <= {
            stage for r in run for stage in r.stage_s}
        assert sum(r.inferences for r in run) > 2
        assert sum(r.inferences > 0 for r in run) < len(run) / 2, 'on demand'

    @pytest.mark.parametrize('tracker', ['image', 'paper'])
    def test_the_model_at_every_image(self, clip: Clip, tracker: str) -> None:
        pipeline = _pipeline(clips.config(tracking__tracker=tracker, model__infer='every_image'))
        results = _feed(pipeline, clip, range(18))
        _sane(results)
        tracked = [r for r in results if r.status is TRACKED]
        assert len(tracked) > 5
        assert all(r.inferences >= 1 and r.window for r in tracked[1:])
        assert any(r.kappa is not None for r in tracked)
        assert _ate(_poses(results), clip) < 0.12   # the paper's solve drifts more

    def test_the_papers_tracker_on_demand(self, clip: Clip) -> None:
        results = _feed(_pipeline(clips.config(tracking__tracker='paper')), clip, range(34))
        _sane(results)
        poses = _poses(results)
        assert len(poses) == 34 and _ate(poses, clip) < 0.12

    def test_without_a_calibration(self, clip: Clip) -> None:
        """It assumes the field of view, here 62.7 degrees: 1 % from the default's focal length."""
        pipeline = _pipeline(clips.config(camera__use_calibration=False))
        results = _feed(pipeline, clip, range(30))
        _sane(results)
        assert len(_poses(results)) == 30 and _ate(_poses(results), clip) < 0.08


BAD_IMAGES = {
    'black': (np.zeros((240, 320, 3), np.uint8), 'constant'),
    'white': (np.full((240, 320, 3), 255, np.uint8), 'constant'),
    'tiny': (clips.noise(0, (16, 12)), 'too small'),
    'empty': (np.zeros((0, 0, 3), np.uint8), 'too small'),
    'larger': (clips.noise(0, (640, 480)), '640x480'),
    'grey': (clips.noise(0)[..., 0], r'H,W,3'),
    'float': (clips.noise(0).astype(np.float32), 'float32'),
}


class TestBadInput:
    @pytest.mark.parametrize('kind', BAD_IMAGES)
    def test_a_bad_image_is_skipped_and_tracking_goes_on(
            self, clip: Clip, run: list[FrameResult], kind: str) -> None:
        image, reason = BAD_IMAGES[kind]
        pipeline = _pipeline()
        before = _feed(pipeline, clip, range(BEGUN))
        skipped = pipeline.process(clip.stamps_ns[BEGUN], image, clip.K)
        assert skipped.status is SKIPPED and reason in skipped.reason
        after = _feed(pipeline, clip, range(BEGUN + 1, BEGUN + 5))
        _sane([*before, skipped, *after])
        assert all(r.status is TRACKED for r in after)
        truth = _poses(run)
        # the same map, one image missing: the same pose within the noise of following
        for r in after:
            assert r.T_world_cam is not None
            offset = (r.T_world_cam - truth[r.stamp_ns])[:3, 3].norm()
            assert float(offset) * _unit(truth, clip) < 0.03

    def test_stamps_that_go_back_are_skipped(self, clip: Clip) -> None:
        pipeline = _pipeline()
        _feed(pipeline, clip, range(BEGUN))
        for index in (BEGUN - 1, 3):
            late = pipeline.process(clip.stamps_ns[index], clip.images[index], clip.K)
            assert late.status is SKIPPED and 'not newer' in late.reason
        assert _feed(pipeline, clip, [BEGUN])[0].status is TRACKED

    def test_bad_images_before_the_map(self, clip: Clip) -> None:
        """Cameras begin with black or half-sized frames."""
        pipeline = _pipeline()
        for k, (image, _) in enumerate(BAD_IMAGES[name] for name in ('black', 'tiny', 'float')):
            assert pipeline.process(k - 10, image, None).status is SKIPPED
        assert len(_poses(_feed(pipeline, clip, range(BEGUN)))) == BEGUN

    @pytest.mark.parametrize('size', [(1200, 40), (40, 600), (33, 33)])
    def test_no_shape_of_image_is_fatal(self, size: tuple[int, int]) -> None:
        pipeline = _pipeline(clips.config(initialisation__max_frames=3))
        image = clips.noise(2, size)
        _sane(pipeline.process(k, np.roll(image, 2 * k, 1), None) for k in range(6))

    def test_a_stream_without_texture_is_not_fatal(self) -> None:
        """Fog: contrast enough to enter, nothing to follow."""
        ramp = np.linspace(60, 120, 320).astype(np.uint8)
        image = np.repeat(np.tile(ramp, (240, 1))[..., None], 3, 2)
        pipeline = _pipeline(clips.config(initialisation__max_frames=3))
        _sane(pipeline.process(k, image, None) for k in range(6))

    def test_a_gap_in_time_is_no_leap(self, clip: Clip) -> None:
        """The driver was stopped for an hour in front of the same scene."""
        pipeline = _pipeline()
        _feed(pipeline, clip, range(BEGUN))
        hour = 3600 * 10 ** 9
        results = _feed(pipeline, clip, range(BEGUN, BEGUN + 3), later_ns=hour)
        _sane(results)
        assert all(r.status is TRACKED for r in results)


class TestLoss:
    @staticmethod
    def _noise(pipeline: FrontendPipeline, clip: Clip, count: int,
               last_ns: int) -> list[FrameResult]:
        step = clip.stamps_ns[1] - clip.stamps_ns[0]
        return [pipeline.process(last_ns + (k + 1) * step, clips.noise(k), clip.K)
                for k in range(count)]

    def test_unrelated_images_lose_it_and_the_scene_finds_it(self, clip: Clip,
                                                             run: list[FrameResult]) -> None:
        pipeline = _pipeline()
        _feed(pipeline, clip, range(36))
        lost = self._noise(pipeline, clip, 5, clip.stamps_ns[35])
        _sane(lost)
        assert [r.status for r in lost] == [LOST] * 5
        assert all(not r.events for r in lost), 'nothing of it enters the map'
        # back in view, but far from where it was lost
        later = lost[-1].stamp_ns - clip.stamps_ns[8]
        found = _feed(pipeline, clip, range(9, 14), later)
        _sane(found)
        assert [r.status for r in found] == [TRACKED] * 5
        truth = _poses(run)
        for r in found:
            assert r.piece_id == 0 and r.T_world_cam is not None
            offset = (r.T_world_cam - truth[r.stamp_ns - later])[:3, 3].norm()
            assert float(offset) * _unit(truth, clip) < 0.05

    def test_one_bad_image_is_no_loss_of_the_map(self, clip: Clip) -> None:
        pipeline = _pipeline()
        _feed(pipeline, clip, range(BEGUN))
        self._noise(pipeline, clip, 1, clip.stamps_ns[BEGUN - 1])
        later = 2 * (clip.stamps_ns[1] - clip.stamps_ns[0])
        assert _feed(pipeline, clip, [BEGUN], later)[0].status is TRACKED

    def test_it_gives_up_and_begins_anew(self, clip: Clip) -> None:
        pipeline = _pipeline(clips.config(relocalisation__give_up_after=4))
        _feed(pipeline, clip, range(BEGUN))
        old = len(pipeline.keyframes)
        lost = self._noise(pipeline, clip, 4, clip.stamps_ns[BEGUN - 1])
        assert [r.status for r in lost] == [LOST] * 4
        assert 'new map piece' in lost[3].reason and 'new map piece' not in lost[2].reason
        later = lost[-1].stamp_ns + 1
        again = _feed(pipeline, clip, range(BEGUN), later)
        _sane([*lost, *again])
        tracked = [r for r in again if r.status is TRACKED]
        assert again[0].status is INITIALISING and len(tracked) > 3
        assert {r.piece_id for r in tracked} == {1}
        new = [e for r in again for e in r.events]
        assert new[0].keyframe_id == old, 'ids are never used again'
        assert {e.piece_id for e in new} == {1}
        assert all(edge.a >= old for e in new for edge in e.edges), 'no edge between pieces'
        assert {k.piece_id for k in pipeline.keyframes} == {0, 1}
        assert _ate(_poses(again), clip, later) < 0.05


class TestRotation:
    def _turning(self, clip: Clip, count: int) -> list[np.ndarray]:
        return [clips.turned(clip.images[10], clip.K, (0.0, 0.04 * k, 0.0))
                for k in range(count)]

    def test_turning_only_from_the_start(self, clip: Clip) -> None:
        """No depth is ever measured; the poses are rotations all the same."""
        pipeline = _pipeline(clips.config(initialisation__max_frames=5))
        results = [pipeline.process(k, image, clip.K)
                   for k, image in enumerate(self._turning(clip, 16))]
        _sane(results)
        assert [r.status for r in results[:4]] == [INITIALISING] * 4
        poses = _poses(results)
        assert len(poses) >= 10 and pipeline.rotation_only_inferences > 0
        last = results[-1].T_world_cam
        assert last is not None
        # from frame 4 to 15, at 2.29 degrees each
        assert math.degrees(sim3.angle_rad(poses[4], last)) == pytest.approx(25.2, abs=1.5)
        assert float((last - poses[4])[:3, 3].norm()) < 0.1, 'of a depth of 1'
        assert len(pipeline.keyframes) > 1, 'it turned away from the first'
        _edges_fit(pipeline, results)

    def test_turning_in_a_world_of_another_unit(self, clip: Clip) -> None:
        """A carried pointmap is in the world's unit, not in that of an inference."""
        pipeline = _pipeline(clips.config(sigma__max_window=2))
        _feed(pipeline, clip, range(11))
        larger = sim3.with_scale(sim3.identity(), 3.0)
        pipeline.apply_correction(CorrectedKeyframes(1, tuple(
            KeyframePose(k.keyframe_id, larger @ k.T_world_kf) for k in pipeline.keyframes)))
        results = [pipeline.process(clip.stamps_ns[10] + 1 + k, image, clip.K)
                   for k, image in enumerate(self._turning(clip, 16))]
        _sane(results)
        assert any(r.events for r in results) and pipeline.rotation_only_inferences > 0
        _edges_fit(pipeline, results)

    def test_turning_in_the_middle(self, clip: Clip) -> None:
        pipeline = _pipeline()
        _feed(pipeline, clip, range(11))
        start = clip.stamps_ns[10]
        step = clip.stamps_ns[1] - clip.stamps_ns[0]
        results = [pipeline.process(start + (k + 1) * step, image, clip.K)
                   for k, image in enumerate(self._turning(clip, 16))]
        _sane(results)
        first, last = results[0].T_world_cam, results[-1].T_world_cam
        assert first is not None and last is not None
        assert math.degrees(sim3.angle_rad(first, last)) == pytest.approx(34.4, abs=1.0)
        assert any(r.events for r in results)
        _edges_fit(pipeline, results)


class TestCorrection:
    T = sim3.from_parts(1.7, sim3.exp(torch.tensor([0., 0, 0, .2, -.9, .3, 0]).double())[:3, :3],
                        torch.tensor([4.0, -2.0, 1.0]))

    def _corrected(self, clip: Clip, known: int | None = None) -> list[FrameResult]:
        """As ``run``, with the world moved by T after the first images."""
        pipeline = _pipeline()
        _feed(pipeline, clip, range(BEGUN))
        poses = tuple(KeyframePose(k.keyframe_id, self.T @ k.T_world_kf)
                      for k in pipeline.keyframes[:known])
        pipeline.apply_correction(CorrectedKeyframes(1, poses))
        return _feed(pipeline, clip, range(BEGUN, 32))

    @pytest.mark.parametrize('known', [None, 2])
    def test_everything_after_it_lives_in_the_corrected_world(
            self, clip: Clip, run: list[FrameResult], known: int | None) -> None:
        """Also when it does not know the newest keyframes yet."""
        results = self._corrected(clip, known)
        _sane(results)
        before = _poses(run)
        assert all(r.status is TRACKED for r in results)
        for r in results:
            assert r.T_world_cam is not None
            expected = sim3.rigid_part(self.T @ before[r.stamp_ns])
            assert sim3.angle_rad(r.T_world_cam, expected) < 0.02
            offset = float((r.T_world_cam - expected)[:3, 3].norm()) / 1.7
            assert offset * _unit(before, clip) < 0.05

    def test_the_next_event_is_in_the_corrected_world(self, clip: Clip,
                                                      run: list[FrameResult]) -> None:
        new = [e for r in self._corrected(clip) for e in r.events if e.observations == 1]
        old = {e.stamp_ns: e for r in run for e in r.events if e.observations == 1}
        assert new
        common = [e for e in new if e.stamp_ns in old]
        for event in common:
            assert _depth_in_world(event) == pytest.approx(
                1.7 * _depth_in_world(old[event.stamp_ns]), rel=0.05)

    def test_before_the_map_and_of_nothing_known_it_is_harmless(self, clip: Clip) -> None:
        pipeline = _pipeline()
        nothing = CorrectedKeyframes(1, (KeyframePose(99, self.T),))
        pipeline.apply_correction(nothing)
        _feed(pipeline, clip, range(BEGUN))
        before = [k.T_world_kf for k in pipeline.keyframes]
        pipeline.apply_correction(nothing)
        pipeline.apply_correction(CorrectedKeyframes(2, ()))
        assert all(torch.equal(a, k.T_world_kf) for a, k in zip(before, pipeline.keyframes))
        assert _feed(pipeline, clip, [BEGUN])[0].status is TRACKED


@pytest.mark.parametrize('name, step, limit_m', [('tum_fr1_xyz', 3, 0.03),
                                                 ('redkitchen_600', 3, 0.06)])
def test_real_recordings(name: str, step: int, limit_m: float) -> None:
    """The first 5 s; the limits are about twice what was measured."""
    if not (DATA / name).exists():
        pytest.skip(f'{DATA / name} is not here')
    sequence = load_sequence(DATA / name)
    pipeline = _pipeline()
    results = [pipeline.process(int(sequence.stamps_ns[i]), sequence.image(i), sequence.K)
               for i in range(0, 150, step)]
    _sane(results)
    poses, truth = _poses(results), sequence.groundtruth
    assert truth is not None and len(poses) >= 0.9 * len(results)
    nearest = np.abs(truth.stamps_ns[None] - np.array(list(poses))[:, None]).argmin(1)
    ate = room_walk.ate(torch.stack(list(poses.values())),
                        torch.from_numpy(truth.T_world_cam[nearest]))
    assert ate < limit_m
