"""A tracked image becomes a keyframe; the window's keyframes learn from the inference."""

from __future__ import annotations

import math
from dataclasses import replace

import clip as clips
import pytest
import torch
from clip import Clip
from torch import Tensor

from aim_slam_ros.config import FollowingConfig, KeyframesConfig
from aim_slam_ros.frontend.following import Followed, Follower
from aim_slam_ros.frontend.initialisation import Beginning
from aim_slam_ros.frontend.keyframe_map import KeyframeMap
from aim_slam_ros.frontend.landmarks import followed_corners
from aim_slam_ros.frontend.promotion import Promotion
from aim_slam_ros.frontend.tracking import TrackingResult
from aim_slam_ros.frontend.window import WindowEstimate
from aim_slam_ros.geometry import camera, sim3
from aim_slam_ros.types import KeyframePose, WindowPrediction

UNIT = 0.6      # metres per unit of the prediction


def _prediction(clip: Clip, indices: list[int], confidence: float = 6.0,
                rotation_only: bool = False) -> WindowPrediction:
    """What a model that makes no errors says of these views."""
    depth = torch.stack([clip.depth_of(i) for i in indices]) / UNIT
    K = clip.frame(0).K
    assert K is not None
    T = torch.stack([clip.T_a_b(indices[0], i) for i in indices])
    T[:, :3, 3] /= UNIT
    return WindowPrediction(depth, torch.full(depth.shape, confidence),
                            K.expand(len(indices), 3, 3), T, rotation_only)


def _estimate(clip: Clip, keyframes: KeyframeMap, index: int, prediction: WindowPrediction,
              ok: bool = True) -> WindowEstimate:
    T = sim3.with_scale(clip.T_world_cam[index], UNIT)
    return WindowEstimate(keyframes.piece, prediction, TrackingResult(ok, T, 1.0, 0.5))


def _followed(clip: Clip, keyframes: KeyframeMap, index: int) -> Followed:
    frame = clip.frame(index)
    assert frame.K is not None
    config = FollowingConfig()
    return Follower(config, followed_corners(config)).follow(
        frame.grey, frame.K, clip.T_world_cam[index], keyframes.piece)


def _K(clip: Clip) -> Tensor:
    K = clip.frame(0).K
    assert K is not None
    return K


def _nowhere() -> Followed:
    none = torch.zeros(0, 3).numpy()
    return Followed(False, sim3.identity(), 0.0, {}, none, none[:, :2], 'lost')


def test_the_oldest_view_is_the_world(clip: Clip) -> None:
    keyframes = clips.true_map(clip, [])
    prediction = _prediction(clip, [12, 6, 9])
    first, second = clips.promotion(keyframes).begin(Beginning(
        tuple(clips.encoding(clip, i) for i in (12, 6, 9)), prediction, (), True))
    assert torch.equal(first.T_world_kf, sim3.identity())
    assert [first.stamp_ns, second.stamp_ns] == [clip.stamps_ns[6], clip.stamps_ns[12]]
    truth = clip.T_a_b(6, 12)
    truth[:3, 3] /= UNIT
    assert torch.allclose(second.T_world_kf, truth)
    assert torch.allclose(first.points_cam[..., 2] * UNIT, clip.depth_of(6))


def test_without_measured_depth_a_map_begins_with_one_keyframe(clip: Clip) -> None:
    keyframes = clips.true_map(clip, [])
    begun = clips.promotion(keyframes).begin(Beginning(
        tuple(clips.encoding(clip, i) for i in (12, 6)), _prediction(clip, [12, 6]), (), False))
    assert len(begun) == 1 and begun[0].stamp_ns == clip.stamps_ns[12]


def test_a_keyframe_keeps_its_unit_in_its_pose(clip: Clip) -> None:
    keyframes = clips.true_map(clip, [10], (2.0,))
    new = clips.promotion(keyframes).promote(
        clips.encoding(clip, 14), _followed(clip, keyframes, 14),
        _estimate(clip, keyframes, 14, _prediction(clip, [14, 10])), _K(clip))
    assert new is not None and new is keyframes.piece[-1]
    assert float(sim3.scale_of(new.T_world_kf)) == pytest.approx(UNIT)
    K = _K(clip)
    truth = sim3.transform(clip.T_world_cam[14], camera.unproject(clip.depth_of(14), K))
    assert torch.allclose(sim3.transform(new.T_world_kf, new.points_cam), truth, atol=1e-3)


@pytest.mark.parametrize('rotation_only, confidence', [(True, 1.001), (False, 1.001),
                                                       (True, 6.0)])
def test_without_measured_depth_the_followed_points_carry_over(
        clip: Clip, rotation_only: bool, confidence: float) -> None:
    keyframes = clips.true_map(clip, [10], (2.0,))
    followed = _followed(clip, keyframes, 13)
    prediction = _prediction(clip, [13, 10], confidence, rotation_only)
    new = clips.promotion(keyframes).promote(
        clips.encoding(clip, 13), followed, _estimate(clip, keyframes, 13, prediction), _K(clip))
    assert new is not None and float(sim3.scale_of(new.T_world_kf)) == pytest.approx(1.0)
    assert bool(torch.isfinite(new.points_cam).all()) and float(new.points_cam[..., 2].min()) > 0
    error = (new.points_cam[..., 2] / clip.depth_of(13)).log().abs()
    at = torch.from_numpy(followed.uv).round().long()
    # within a few pixels of corners, many of which are depth edges
    assert float(error[at[:, 1], at[:, 0]].median()) < 0.05
    assert float(error.median()) < 0.15, 'between them it is at least the right wall'
    sure = new.confidence[at[:, 1], at[:, 0]].min()
    assert sure > new.confidence.min() and new.confidence.max() < 2.0, 'and it is honest'


def test_a_plane_carries_over_as_it_is(clip: Clip) -> None:
    """A floor, of which inverse depth is linear in the image: no keyframe may push it away."""
    keyframes = clips.true_map(clip, [10])
    encoding, K = clips.encoding(clip, 13), _K(clip)
    height, width = encoding.frame.height, encoding.frame.width
    x, z = torch.meshgrid(torch.linspace(-20, 20, 201), torch.linspace(2, 20, 60), indexing='ij')
    floor = torch.stack([x, torch.full_like(x, 1.2), z], -1).reshape(-1, 3).double()
    uv = camera.project(floor, K)
    seen = camera.inside(uv, height, width)
    followed = Followed(True, sim3.identity(), 0.2, {0: 0.2}, floor[seen].numpy(),
                        uv[seen].float().numpy())
    nothing = _estimate(clip, keyframes, 13, _prediction(clip, [13, 10], 1.001, True))
    new = clips.promotion(keyframes).promote(encoding, followed, nothing, K)
    assert new is not None
    u, v = uv[seen].round().long().T
    at_pixel = K[1, 1] * 1.2 / (v - K[1, 2])
    error = (new.points_cam[v, u, 2] / at_pixel).log()
    z = floor[seen, 2]
    inside = (z > 3) & (z < 15) & (u > 25) & (u < width - 25)   # of all points: linear between
    assert abs(float(error.median())) < 1e-3 and float(error[inside].abs().quantile(0.95)) < 2e-3


def test_nothing_known_makes_no_keyframe(clip: Clip) -> None:
    keyframes = clips.true_map(clip, [10])
    prediction = _prediction(clip, [13, 10], 1.001, True)
    got = clips.promotion(keyframes).promote(
        clips.encoding(clip, 13), _nowhere(),
        _estimate(clip, keyframes, 13, prediction, ok=False), _K(clip))
    assert got is None and len(keyframes.all) == 1


def test_observations_are_fused_in_the_keyframes_unit(clip: Clip) -> None:
    keyframes = clips.true_map(clip, [10], (2.0,))
    before = keyframes[0]
    clips.promotion(keyframes).learn(
        _estimate(clip, keyframes, 12, _prediction(clip, [12, 10])))
    after = keyframes[0]
    assert after.observations == 2
    assert torch.allclose(after.points_cam, before.points_cam, rtol=1e-3)
    assert float(after.confidence.mean()) == pytest.approx(10.0)


def test_what_does_not_agree_is_not_fused(clip: Clip) -> None:
    """Depths of another place: the scatter of the ratios gives it away."""
    keyframes = clips.true_map(clip, [10])
    prediction = _prediction(clip, [12, 10])
    prediction.depth[1] = prediction.depth[1].flip(0, 1) ** 2
    clips.promotion(keyframes).learn(_estimate(clip, keyframes, 12, prediction))
    assert keyframes[0].observations == 1
    unsure = _prediction(clip, [12, 10], 1.001)
    clips.promotion(keyframes).learn(_estimate(clip, keyframes, 12, unsure))
    assert keyframes[0].observations == 1


def test_fusing_uses_the_keyframe_as_it_is_now(clip: Clip) -> None:
    """The window's copy is older than a correction that came in between."""
    keyframes = clips.true_map(clip, [10])
    estimate = _estimate(clip, keyframes, 12, _prediction(clip, [12, 10]))
    moved = clip.T_world_cam[3]
    keyframes.move([KeyframePose(0, moved)])
    clips.promotion(keyframes).learn(estimate)
    assert torch.equal(keyframes[0].T_world_kf, moved) and keyframes[0].observations == 2


def test_keyframes_go_where_the_tracker_put_them(clip: Clip) -> None:
    keyframes = clips.true_map(clip, [10, 14])
    estimate = _estimate(clip, keyframes, 12, _prediction(clip, [12, 10, 14]))
    moved = replace(estimate.result, moved={1: clip.T_world_cam[15]})
    clips.promotion(keyframes).learn(replace(estimate, result=moved))
    assert torch.equal(keyframes[1].T_world_kf, clip.T_world_cam[15])
    assert [p.keyframe_id for p in keyframes.take_moved(0)] == [1], 'and loop closure is told'


def test_an_event_tells_what_loop_closure_needs(clip: Clip) -> None:
    keyframes = clips.true_map(clip, [10, 13, 16], (1.0, 2.0, 0.5))
    keyframes.move([KeyframePose(0, keyframes[0].T_world_kf)])
    measured = {1: sim3.exp(torch.full((7,), 0.1, dtype=torch.float64)), 0: sim3.identity(),
                2: sim3.identity()}
    event = Promotion(KeyframesConfig(long_edge=1), keyframes).event(keyframes[2], measured, 0)
    assert (event.keyframe_id, event.stamp_ns) == (2, clip.stamps_ns[16])
    assert [(e.a, e.b) for e in event.edges] == [(0, 2), (1, 2)], 'no edge to itself'
    long, short = event.edges
    assert torch.equal(long.T_a_b, measured[0]), 'over a long edge the map may have drifted'
    assert torch.allclose(keyframes[1].T_world_kf @ short.T_a_b, keyframes[2].T_world_kf)
    for edge in event.edges:
        assert edge.sigma.shape == (7,) and bool((edge.sigma > 0).all())
    assert [p.keyframe_id for p in event.moved] == [0]
    assert event.image.shape[:2] == event.confidence.shape == event.points_cam.shape[:2]
    # the same surety in metres, whatever the unit of keyframe a
    metres = [float(e.sigma[0] * sim3.scale_of(keyframes[e.a].T_world_kf)) for e in event.edges]
    assert math.isclose(metres[0], metres[1], rel_tol=0.2)


def test_loop_closure_is_told_of_a_keyframe_that_became_much_better(clip: Clip) -> None:
    keyframes = clips.true_map(clip, [10, 14])
    promotion = clips.promotion(keyframes)
    told = [promotion.event(keyframes[k], {}, 0) for k in (0, 1)]
    assert [event.observations for event in told] == [1, 1]
    estimate = _estimate(clip, keyframes, 12, _prediction(clip, [12, 10, 14]))
    for _ in range(2):
        assert promotion.refined() == []
        promotion.learn(estimate)
    again = promotion.refined()
    assert [(event.keyframe_id, event.observations) for event in again] == [(0, 3), (1, 3)]
    assert torch.equal(again[0].confidence, keyframes[0].confidence)
    assert float(again[0].confidence.min()) > float(told[0].confidence.max())
    assert promotion.refined() == [], 'once'


def test_where_nothing_was_measured_the_map_gives_the_edge(clip: Clip) -> None:
    keyframes = clips.true_map(clip, [10, 13], (1.0, 2.0))
    edge, = clips.promotion(keyframes).event(keyframes[1], {}, 0).edges
    assert torch.allclose(keyframes[0].T_world_kf @ edge.T_a_b, keyframes[1].T_world_kf)
    assert clips.promotion(keyframes).event(keyframes[0], {}, 0).edges == ()
