"""Clouds against clouds, with offsets that are known, and a run's map against depth images."""

from __future__ import annotations

import json
import math
import shutil
import time
from pathlib import Path

import clip as clips
import numpy as np
import pytest
import torch

from aim_slam_ros.assessment import assess, reference_cloud
from aim_slam_ros.cli.evaluate import main
from aim_slam_ros.config import Config
from aim_slam_ros.datasets import Sequence, load_sequence
from aim_slam_ros.datasets.rendered import render
from aim_slam_ros.evaluation.reconstruction import CUT_M, VOXEL_M, compare_clouds, thinned
from aim_slam_ros.evaluation.run_result import PlacedKeyframe, RunResult
from aim_slam_ros.geometry import sim3
from aim_slam_ros.types import Cloud, FrameResult, TrackingStatus

FR1 = Path(__file__).resolve().parents[2] / 'shared/data/tum_fr1_xyz'


def plane(z: float, extent: float = 1.0, step: float = 0.01) -> np.ndarray:
    """A square [N,3] across the z axis, each point in the middle of a voxel."""
    side = np.arange(0.0, extent, step)
    x, y = np.meshgrid(side, side)
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, z)], 1)


def test_a_shifted_plane_is_as_far_off_as_it_was_shifted() -> None:
    """Every point's nearest is the one above it, so only rounding is left."""
    error = compare_clouds(plane(0.1), plane(0.0))
    assert error is not None
    assert error.accuracy_m == pytest.approx(0.1, abs=1e-9)
    assert error.completion_m == pytest.approx(0.1, abs=1e-9)
    assert error.chamfer_m == pytest.approx(0.1, abs=1e-9)


def test_half_a_surface_is_accurate_but_not_complete() -> None:
    """A strip of .2 m, .1 of it missing: distances 0 to .1, evenly, for half of its points."""
    strip = plane(0.0, extent=0.2)
    half = strip[strip[:, 0] < 0.0999]
    error = compare_clouds(half, strip)
    assert error is not None
    assert error.accuracy_m == pytest.approx(0.0, abs=1e-9)
    # rms of d uniform on [0, .1] is .1/sqrt(3), and half the points have none; 10 steps of 1 cm
    steps = np.arange(1, 11) * 0.01
    assert error.completion_m == pytest.approx(math.sqrt(0.5 * np.mean(steps ** 2)), rel=1e-6)
    assert error.chamfer_m == pytest.approx(0.5 * error.completion_m, rel=1e-6)


def test_outliers_count_as_the_cut_however_far_they_are() -> None:
    """One point in a hundred far away: sqrt(.01) of the cut."""
    surface = plane(0.0, extent=0.0999)
    assert len(surface) == 100
    for far in (0.7, 700.0):
        error = compare_clouds(np.vstack([surface[:99], [[0.0, 0.0, far]]]), surface)
        assert error is not None
        assert error.accuracy_m == pytest.approx(0.1 * CUT_M, rel=1e-6)


def test_what_was_seen_often_weighs_no_more() -> None:
    """A thousand copies of a bad point are one."""
    surface = plane(0.0)
    bad = np.repeat([[0.0, 0.0, 0.2]], 1000, 0)
    once, often = (compare_clouds(np.vstack([surface, points]), surface)
                   for points in (bad[:1], bad))
    assert once is not None and often is not None
    assert often.accuracy_m == pytest.approx(once.accuracy_m, rel=1e-12)


def test_thinning_leaves_the_mean_of_each_voxel() -> None:
    points = np.array([[0.0, 0, 0], [0.04, 0, 0], [0.06, 0, 0], [1, 1, np.nan], [0, np.inf, 0]])
    assert np.allclose(thinned(points, 0.1), [[0.02, 0, 0], [0.06, 0, 0]])
    random = np.random.default_rng(0).uniform(-0.1, 0.1, (20000, 3))
    thin = thinned(random, VOXEL_M)
    cells = np.unique(np.rint(thin / VOXEL_M), axis=0)
    assert len(cells) == len(thin) == len(np.unique(np.rint(random / VOXEL_M), axis=0))


@pytest.mark.parametrize('points', [np.zeros((0, 3)), np.full((5, 3), np.nan)])
def test_nothing_cannot_be_compared(points: np.ndarray) -> None:
    assert compare_clouds(points, plane(0.0)) is None
    assert compare_clouds(plane(0.0), points) is None


# A run's map against the depth images of its sequence.

@pytest.fixture(scope='module')
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A few small frames of the rendered room with exact depth."""
    folder = tmp_path_factory.mktemp('data') / 'room'
    render('room', folder, frames=slice(0, 48, 4), size=clips.SIZE)
    return folder


def run_with(sequence: Sequence, points: np.ndarray) -> RunResult:
    """The true path and this cloud, in a world of half the size that lies elsewhere."""
    assert sequence.groundtruth is not None
    T_estimate_true = sim3.exp(torch.tensor([0.3, -1.0, 2.0, 0.4, 0.1, -0.7, math.log(0.5)],
                                            dtype=torch.float64))
    keyframes, results = [], []
    for i, stamp in enumerate(sequence.stamps_ns.tolist()):
        T = T_estimate_true @ torch.from_numpy(sequence.groundtruth.T_world_cam[i])
        keyframes.append(PlacedKeyframe(i, 0, stamp, T))
        results.append(FrameResult(stamp, TrackingStatus.TRACKED, sim3.rigid_part(T), i,
                                   sim3.identity()))
    cloud = sim3.transform(T_estimate_true, torch.from_numpy(points)).numpy()
    return RunResult(tuple(results), (), len(results), 1.0, {}, tuple(keyframes),
                     Cloud(cloud, np.zeros(cloud.shape, np.uint8)), 0, False, ())


def true_cloud(sequence: Sequence) -> np.ndarray:
    cloud = reference_cloud(sequence, int(sequence.stamps_ns[0]), int(sequence.stamps_ns[-1]))
    assert cloud is not None
    return cloud


def test_a_true_map_has_no_error_whatever_its_unit(room: Path) -> None:
    """The alignment is exact; its rounding may put points into other voxels, no more."""
    sequence = load_sequence(room)
    figures = assess(run_with(sequence, true_cloud(sequence)), sequence, Config()).figures
    for name in ('accuracy', 'completion', 'chamfer'):
        value = figures[f'reconstruction_{name}_m']
        assert isinstance(value, float) and value < VOXEL_M


def test_a_map_in_front_of_the_walls_is_less_accurate(room: Path) -> None:
    """Every true point moved by a known length: no nearest distance can be longer, and on a
    scene of planes and corners most are not much shorter."""
    sequence = load_sequence(room)
    moved = true_cloud(sequence) + 0.1 / math.sqrt(3.0)
    figures = assess(run_with(sequence, moved), sequence, Config()).figures
    accuracy = figures['reconstruction_accuracy_m']
    assert isinstance(accuracy, float) and 0.03 < accuracy < 0.1 + VOXEL_M


def test_the_reference_is_where_the_sensor_saw_it(room: Path) -> None:
    """A point of the cloud from each image lies on that image's depth."""
    sequence = load_sequence(room)
    truth, K = sequence.groundtruth, sequence.K
    assert truth is not None and K is not None
    stamp = int(sequence.stamps_ns[3])
    cloud = reference_cloud(sequence, stamp, stamp)
    depth = sequence.depth(3)
    assert cloud is not None and depth is not None
    R, t = truth.T_world_cam[3][:3, :3], truth.T_world_cam[3][:3, 3]
    points = (cloud - t) @ R
    uv = points[:, :2] / points[:, 2:] * [K[0, 0], K[1, 1]] + K[:2, 2]
    u, v = np.rint(uv).astype(int).T
    assert np.abs(uv - np.rint(uv)).max() < 1e-3    # float32 points: whole pixels
    assert np.allclose(depth[v, u], points[:, 2], atol=1e-4)


def test_damaged_or_missing_depth_is_done_without(room: Path, tmp_path: Path) -> None:
    folder = tmp_path / 'room'
    shutil.copytree(room, folder)
    sequence = load_sequence(folder)
    whole = len(true_cloud(sequence))
    files = sorted((folder / 'depth').iterdir())
    files[0].write_bytes(b'no image')
    files[1].unlink()
    assert 0 < len(true_cloud(sequence)) < whole
    (folder / 'associations.txt').unlink()
    without = load_sequence(folder)
    figures = assess(run_with(without, plane(0.0)), without, Config()).figures
    assert figures['reconstruction_chamfer_m'] is None and figures['ate_rmse_m'] is not None


def test_evaluate_writes_and_prints_the_figures(room: Path, tmp_path: Path,
                                                capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(room), '--out', str(tmp_path), '--set', 'camera.width=280']) == 0
    figures = json.loads((tmp_path / 'metrics.json').read_text(encoding='utf-8'))
    # the model sees a few small images: the map is rough, but of the room
    assert 0.0 < figures['reconstruction_accuracy_m'] < CUT_M
    assert 0.0 < figures['reconstruction_completion_m'] < CUT_M
    assert 'map accuracy / completion [m]' in capsys.readouterr().out


@pytest.mark.skipif(not FR1.is_dir(), reason='needs the recording tum_fr1_xyz')
def test_a_recorded_sequence_is_compared_in_seconds() -> None:
    """With its own depth as the map, the largest cloud that can come: 5 s on two cores."""
    sequence = load_sequence(FR1)
    start = time.perf_counter()
    reference = true_cloud(sequence)
    error = compare_clouds(reference, reference)
    assert time.perf_counter() - start < 5.0
    assert error is not None and error.chamfer_m == 0.0
