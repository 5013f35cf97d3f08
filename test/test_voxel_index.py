"""The voxel index against a brute-force set intersection."""

from __future__ import annotations

import box_room
import numpy as np
import pytest
import torch
from torch import Tensor

from aim_slam_ros.config import SigmaConfig
from aim_slam_ros.frontend.voxel_index import (VoxelIndex, VoxelIndexError, confident_points,
                                               relative_voxel_size)

SIZE = 0.25


def _clouds(count: int) -> dict[int, Tensor]:
    """Overlapping clouds under sparse ids."""
    rng = torch.Generator().manual_seed(0)
    return {3 + 7 * k: torch.rand(400, 3, generator=rng) * 2 + torch.tensor([0.4 * k, -1.0, 0.0])
            for k in range(count)}


def _cells(points: Tensor) -> set[tuple[int, ...]]:
    return {tuple(c) for c in np.floor(points.double().numpy() / SIZE).astype(int).tolist()}


def _assert_exact(index: VoxelIndex, clouds: dict[int, Tensor]) -> None:
    query = next(iter(clouds))
    got = index.overlap_of(query)
    expected = {k: len(_cells(clouds[query]) & _cells(cloud))
                for k, cloud in clouds.items() if k != query}
    assert dict(zip(got.keyframe_ids.tolist(), got.counts.tolist())) == {
        k: n for k, n in expected.items() if n}
    assert (np.diff(got.counts) <= 0).all()


def _indexed(clouds: dict[int, Tensor]) -> VoxelIndex:
    index = VoxelIndex(SIZE)
    for keyframe_id, cloud in clouds.items():
        index.insert(keyframe_id, cloud)
    return index


def test_overlap_is_exact_after_insert_and_move() -> None:
    clouds = _clouds(8)
    index = _indexed(clouds)
    _assert_exact(index, clouds)
    clouds[10] = clouds[10] + torch.tensor([0.6, -0.3, 0.1])
    index.move(10, clouds[10])
    _assert_exact(index, clouds)
    assert len(index) == 8 and 10 in index and 11 not in index


def test_what_is_not_finite_or_astronomically_far_is_ignored() -> None:
    index = VoxelIndex(1e-3)
    bad = torch.tensor([[float('nan'), 0, 0], [float('inf'), 0, 0], [1e9, 0, 0]])
    index.insert(0, bad)
    index.insert(1, torch.cat([bad, torch.zeros(1, 3)]))
    index.insert(2, torch.zeros(1, 3))
    assert len(index.overlap_of(0).keyframe_ids) == 0
    assert index.overlap_of(1).keyframe_ids.tolist() == [2]


def test_wrong_use_is_named() -> None:
    index = _indexed(_clouds(2))
    with pytest.raises(VoxelIndexError, match='move it'):
        index.insert(3, torch.zeros(1, 3))
    with pytest.raises(VoxelIndexError, match='insert it first'):
        index.overlap_of(4)
    with pytest.raises(VoxelIndexError, match='insert it first'):
        index.move(4, torch.zeros(1, 3))
    for size in (0.0, float('nan')):
        with pytest.raises(VoxelIndexError, match='finite'):
            VoxelIndex(size)


def test_voxels_do_not_depend_on_the_keyframes_unit() -> None:
    config, T = SigmaConfig(), box_room.trajectory(1)[0]
    metres, feet = box_room.keyframe(0, T), box_room.keyframe(1, T, unit=0.3048)
    assert relative_voxel_size(feet, config) == pytest.approx(
        relative_voxel_size(metres, config), rel=1e-5)
    depth = box_room.depth_of(T).median()
    assert relative_voxel_size(metres, config) == pytest.approx(0.06 * float(depth), rel=0.02)
    index = VoxelIndex(relative_voxel_size(metres, config))
    index.insert(0, confident_points(metres, config))
    index.insert(1, confident_points(feet, config))
    index.insert(2, confident_points(metres, config))
    voxels = index.overlap_of(2)
    # float32 rounding may move a point across a face, nothing more
    assert voxels.counts.min() > 0.97 * voxels.counts.max()


def test_only_confident_points_are_indexed() -> None:
    config, keyframe = SigmaConfig(), box_room.keyframe(0, box_room.trajectory(1)[0])
    offered = keyframe.confidence[::4, ::4].numel()
    keyframe.confidence[:] = torch.rand(keyframe.confidence.shape,
                                        generator=torch.Generator().manual_seed(0))
    keyframe.points_cam[0, 0] = float('nan')
    points = confident_points(keyframe, config)
    assert bool(torch.isfinite(points).all())
    assert len(points) == pytest.approx(0.9 * offered, rel=0.01)
