"""The map file and the page of pictures."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from aim_slam_ros.evaluation import orthographic
from aim_slam_ros.evaluation.reconstruction import write_ply
from aim_slam_ros.evaluation.report import ReportData, write_report
from aim_slam_ros.evaluation.trajectory import Incomparable, compare
from aim_slam_ros.evaluation.viewpoint import view_axes
from aim_slam_ros.geometry import sim3
from aim_slam_ros.types import Cloud, FrameResult, StampedPoses, TrackingStatus

RED, BLUE = (200, 0, 0), (0, 0, 200)
NO_POSES = StampedPoses(np.zeros(0, np.int64), np.zeros((0, 4, 4)))


def square(z: float, colour: tuple[int, int, int], half: float = 1.0) -> Cloud:
    """A densely sampled square across the third axis."""
    x, y = np.meshgrid(np.linspace(-half, half, 300), np.linspace(-half, half, 300))
    points = np.stack([x, y, np.full_like(x, z)], -1).reshape(-1, 3).astype(np.float32)
    return Cloud(points, np.tile(np.array(colour, np.uint8), (len(points), 1)))


def joined(*clouds: Cloud) -> Cloud:
    return Cloud(np.concatenate([c.points for c in clouds]),
                 np.concatenate([c.colours for c in clouds]))


def camera_path(look: str, count: int = 40) -> StampedPoses:
    """An upright camera on a small circle in a z-up world, looking along +x or down."""
    forward = {'along': [1.0, 0, 0], 'down': [0.6, 0, -0.8]}[look]
    z = np.array(forward)
    x = np.array([0.0, -1, 0])
    R = torch.from_numpy(np.stack([x, np.cross(z, x), z], 1))
    angle = torch.linspace(0, 6, count, dtype=torch.float64)
    positions = torch.stack([0.3 * angle.cos(), 0.3 * angle.sin(), 0 * angle], -1)
    T = sim3.from_parts(torch.ones(count), R.expand(count, 3, 3), positions)
    return StampedPoses(np.arange(count, dtype=np.int64) * 10**8, T.numpy())


def test_ply_reads_back(tmp_path: Path) -> None:
    cloud = joined(square(1.0, RED), square(2.0, BLUE))
    write_ply(tmp_path / 'map.ply', cloud)
    header, _, body = (tmp_path / 'map.ply').read_bytes().partition(b'end_header\n')
    assert header.decode().splitlines() == [
        'ply', 'format binary_little_endian 1.0', f'element vertex {len(cloud.points)}',
        'property float x', 'property float y', 'property float z',
        'property uchar red', 'property uchar green', 'property uchar blue']
    table = np.frombuffer(body, np.dtype([('xyz', '<f4', 3), ('rgb', 'u1', 3)]))
    np.testing.assert_array_equal(table['xyz'], cloud.points)
    np.testing.assert_array_equal(table['rgb'], cloud.colours)


def test_an_empty_map_is_a_valid_ply(tmp_path: Path) -> None:
    write_ply(tmp_path / 'map.ply', Cloud(np.zeros((0, 3)), np.zeros((0, 3), np.uint8)))
    assert b'element vertex 0' in (tmp_path / 'map.ply').read_bytes()


@pytest.mark.parametrize('order', [(0, 1), (1, 0)])
def test_near_surfaces_cover_far_ones(order: tuple[int, int]) -> None:
    """A small near square before a large far one, whatever their order in the cloud."""
    clouds = (square(1.0, RED, half=0.5), square(2.0, BLUE))
    raster = orthographic.draw(joined(*(clouds[n] for n in order)), np.zeros((0, 2)), 0.0)
    assert raster is not None
    height, width = raster.image.shape[:2]
    assert tuple(raster.image[height // 2, width // 2, :3]) == RED
    assert tuple(raster.image[height // 2, width // 8, :3]) == BLUE
    assert raster.image[height // 2, width // 2, 3] == 255


def test_what_stands_before_the_cameras_is_cut_away() -> None:
    raster = orthographic.draw(joined(square(1.0, RED), square(2.0, BLUE)), np.zeros((0, 2)), 1.5)
    assert raster is not None
    assert not (raster.image[..., 0] == RED[0]).any()
    assert orthographic.draw(square(1.0, RED), np.zeros((0, 2)), 1.5) is None


def test_outliers_do_not_shrink_the_picture() -> None:
    far = Cloud(np.array([[1e4, 0, 2], [0, -1e4, 2]], np.float32), np.zeros((2, 3), np.uint8))
    raster = orthographic.draw(joined(square(2.0, BLUE), far), np.array([[1.5, 0.0]]), 0.0)
    assert raster is not None
    left, right, bottom, top = raster.extent
    assert -1.2 < left < -0.9 and -1.2 < bottom < -0.9 and 0.9 < top < 1.2
    assert 1.5 < right < 1.7    # the path is never cut off


@pytest.mark.parametrize('look', ['along', 'down'])
def test_the_viewer_stands_upright_behind_the_cameras(look: str) -> None:
    poses = camera_path(look)
    axes = view_axes(poses, square(0.0, RED, half=3.0).points, surveyed=True)
    np.testing.assert_allclose(axes, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-9)


@pytest.mark.parametrize('surveyed', [True, False])
def test_axes_are_orthonormal_whatever_was_seen(surveyed: bool) -> None:
    """Also for one camera, and one that looks straight down on its own image-up axis."""
    down = camera_path('along', 1)
    down.T_world_cam[0, :3, :3] = np.diag([1.0, -1, -1])
    for poses in (camera_path('along', 1), down, camera_path('down')):
        axes = view_axes(poses, np.zeros((0, 3)), surveyed=surveyed)
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-9)
        assert np.linalg.det(axes) == pytest.approx(1.0)


def results_of(poses: StampedPoses, lost: range) -> tuple[FrameResult, ...]:
    return tuple(FrameResult(int(stamp), TrackingStatus.LOST if n in lost
                             else TrackingStatus.TRACKED, matched_fraction=0.5)
                 for n, stamp in enumerate(poses.stamps_ns))


@pytest.mark.parametrize('case', ['truth', 'no truth', 'nothing tracked'])
def test_a_report_is_written_whatever_there_is(tmp_path: Path, case: str) -> None:
    truth = camera_path('along')
    results = results_of(truth, range(10, 15))
    kept = np.r_[0:10, 15:40]
    estimate = StampedPoses(truth.stamps_ns[kept], truth.T_world_cam[kept])
    cloud = joined(square(1.0, RED), square(2.0, BLUE))
    if case == 'nothing tracked':
        estimate, cloud = NO_POSES, Cloud(np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
        results = results_of(truth, range(40))
    groundtruth = truth if case == 'truth' else None
    error = compare(estimate, truth) if groundtruth else Incomparable('there is no ground truth')
    write_report(tmp_path / 'report.png', ReportData(
        case, estimate, groundtruth, error, cloud, results,
        {'read': 3.0, 'infer': 30.0}, (('ATE RMSE', '0.012'), ('loops', '2'))))
    picture = cv2.imread(str(tmp_path / 'report.png'))
    assert picture is not None and picture.shape == (1050, 1800, 3)
    map_panels = picture[50:620, 620:].reshape(-1, 3)   # OpenCV reads BGR
    has_map = (np.abs(map_panels.astype(int) - BLUE[::-1]).max(1) < 5).any()
    assert has_map == (case != 'nothing tracked')
