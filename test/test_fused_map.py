"""The fused map: frames, filters, voxels."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from torch import Tensor

from aim_slam_ros.config import LoopClosureConfig
from aim_slam_ros.geometry import camera, sim3
from aim_slam_ros.loop_closure.fused_map import FusedMap
from aim_slam_ros.types import KeyframeEvent

HEIGHT, WIDTH = 84, 112
K = camera.intrinsics_from_fov(WIDTH, HEIGHT, 60.0)
RED = (200, 30, 10)


def wall(keyframe_id: int = 0, depth: Tensor | float = 2.0, unit: float = 1.0,
         colour: tuple[int, int, int] = RED, confidence: float = 5.0) -> KeyframeEvent:
    """A keyframe that looks straight at a wall; ``depth`` in metres, points in ``unit`` metres."""
    z = torch.full((HEIGHT, WIDTH), 1.0) * depth / unit
    image = np.full((HEIGHT, WIDTH, 3), colour, np.uint8)
    T_world_kf = sim3.with_scale(sim3.identity(), unit)
    return KeyframeEvent(keyframe_id, 0, keyframe_id, image, K, camera.unproject(z, K),
                         torch.full((HEIGHT, WIDTH), confidence), T_world_kf, torch.ones(1))


def fused(*events: KeyframeEvent, percentile: float = 0.0, voxel: float = 0.02) -> Tensor:
    """World points [N,3] of a map of these keyframes."""
    return torch.from_numpy(fused_map(*events, percentile=percentile, voxel=voxel)
                            .fuse({e.keyframe_id: e.T_world_kf for e in events}).points)


def fused_map(*events: KeyframeEvent, percentile: float = 0.0, voxel: float = 0.02) -> FusedMap:
    made = FusedMap(LoopClosureConfig(map_percentile=percentile, map_voxel=voxel))
    for event in events:
        made.add(event)
    return made


def test_an_empty_map_is_an_empty_cloud() -> None:
    cloud = fused_map().fuse({})
    assert cloud.points.shape == (0, 3) and cloud.colours.shape == (0, 3)
    assert cloud.points.dtype == np.float32 and cloud.colours.dtype == np.uint8


def test_keyframes_in_different_units_meet_in_the_world() -> None:
    points = fused(wall(0), wall(1, unit=0.3))
    assert torch.allclose(points[:, 2], torch.tensor(2.0), atol=1e-5)
    # Both cover the same voxels, so together they are hardly more than one.
    assert len(points) < 1.2 * len(fused(wall(0)))


def test_a_correction_moves_a_keyframe() -> None:
    made = fused_map(wall(0), wall(1))
    shift = torch.tensor([0.0, 0.0, 5.0], dtype=torch.float64)
    moved = sim3.from_parts(2.0, torch.eye(3), shift)
    cloud = made.fuse({0: sim3.identity(), 1: moved})
    assert sorted(set(cloud.points[:, 2].round(3).tolist())) == [2.0, 9.0]


def test_only_the_keyframes_asked_for_are_fused() -> None:
    assert len(fused_map(wall(0), wall(1, 4.0)).fuse({1: sim3.identity()}).points) > 0
    assert len(fused_map(wall(0)).fuse({7: sim3.identity()}).points) == 0


def test_the_voxel_is_relative_to_the_depth() -> None:
    near, far = fused(wall(0, 1.0), voxel=0.04), fused(wall(0, 50.0), voxel=0.04)
    assert len(near) == pytest.approx(len(far), rel=0.05)
    # The wall is 2 tan 30 deg = 1.15 depths wide and 3/4 as high: in voxels of 4 %, 29 x 22.
    assert len(near) == pytest.approx(29 * 22, rel=0.1)


def test_colours_belong_to_their_points() -> None:
    two = fused_map(wall(0, 2.0), wall(1, 4.0, colour=(0, 0, 255)))
    cloud = two.fuse({0: sim3.identity(), 1: sim3.identity()})
    assert (cloud.colours[cloud.points[:, 2] < 3] == RED).all()
    assert (cloud.colours[cloud.points[:, 2] > 3] == (0, 0, 255)).all()


def test_the_confident_observation_wins() -> None:
    # 2 % apart, in the same voxels of 10 %.
    weak = wall(1, 2.02, confidence=1.1)
    points = fused(wall(0, 2.0, confidence=11.0), weak, voxel=0.1)
    assert float(points[:, 2].median()) == pytest.approx(2.0, abs=0.005)


def test_the_least_confident_part_is_left_out() -> None:
    event = wall(0)
    confidence = event.confidence.clone()
    confidence[:, :WIDTH // 2] = 2.0
    points = fused(dataclasses.replace(event, confidence=confidence), percentile=60.0)
    assert float(points[:, 0].min()) >= -0.05


def test_what_the_model_does_not_know_is_left_out() -> None:
    assert len(fused(wall(0, confidence=1.001))) == 0


def test_outliers_and_depth_edges_are_left_out() -> None:
    depth = torch.full((HEIGHT, WIDTH), 2.0)
    depth[:, WIDTH // 2:] = 4.0
    depth[10, 20] = 3.0                 # a lone pixel
    depth[30:40, 30:40] = 1e7           # nothing that is there
    event = wall(0, depth)
    event.points_cam[50:60, 5:10] = torch.nan
    z = fused(event)[:, 2]
    assert bool(z.isfinite().all())
    assert sorted(set(z.numpy().round(3).tolist())) == [2.0, 4.0]


def test_a_keyframe_without_points_is_harmless() -> None:
    empty = wall(1)
    empty.points_cam[:] = torch.nan
    assert len(fused(wall(0), empty)) == len(fused(wall(0)))
