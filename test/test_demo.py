"""The demo: what is refused and when, and short real runs of two processes over DDS."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from aim_slam_ros.cli.bag_cache import cached_bag
from aim_slam_ros.cli.demo import main
from aim_slam_ros.datasets import load_sequence
from aim_slam_ros.datasets.bag_writing import BagForm, write_bag
from aim_slam_ros.datasets.bags import is_bag
from aim_slam_ros.datasets.rendered import render
from aim_slam_ros.datasets.text import read_tum_trajectory

ROOT = Path(__file__).resolve().parents[1]
RESULTS = {'trajectory.txt', 'keyframes.txt', 'map.ply', 'config.yaml', 'metrics.json',
           'report.png', 'parameters.yaml', 'frontend.log', 'loop_closure.log'}
FRAMES = 44
# At 10 images a second a slow machine loses the camera as the map begins.
QUICK = ['--set', 'camera.width=280', '--rate', '0.4']


@pytest.fixture(scope='module')
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Every third frame of the rendered room's beginning: ten images per second."""
    folder = tmp_path_factory.mktemp('data') / 'room'
    render('room', folder, frames=slice(0, 3 * FRAMES, 3), size=(320, 240))
    return folder


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The user's cache folder."""
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path / 'cache'))
    return tmp_path / 'cache' / 'aim_slam_ros' / 'bags'


def metrics_of(folder: Path) -> dict[str, object]:
    return json.loads((folder / 'metrics.json').read_text(encoding='utf-8'))


def number(figures: dict[str, object], name: str) -> float:
    value = figures[name]
    assert isinstance(value, (int, float)), (name, value)
    return value


def process(*arguments: str) -> subprocess.Popen[str]:
    """The demo in a process of its own, whose signals are those of a terminal."""
    return subprocess.Popen(
        [sys.executable, '-m', 'aim_slam_ros.cli.demo', *arguments], cwd=ROOT,
        env=os.environ | {'PYTHONPATH': str(ROOT)}, text=True, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        # a shell starts background jobs, and so this test, with SIGINT ignored
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL))


# What is refused, before any work.

@pytest.mark.parametrize('arguments, expected', [
    (['--rate', '0'], 'from 0.01 to 100'),
    (['--rate', 'nan'], 'from 0.01 to 100'),
    (['--rate', 'fast'], 'from 0.01 to 100'),
    (['--stride', '0'], 'at least 1'),
    (['--count', '0'], 'at least 1'),
    (['--model', 'magic'], 'is not allowed'),
    (['--set', 'camera.width=7'], 'from 84 to 1036'),
    (['--set', 'camera.width'], 'section.name=value'),
    (['--turbo'], '--turbo'),
])
def test_a_wrong_option_is_refused_with_what_is_allowed(
        room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str],
        expected: str) -> None:
    out = tmp_path / 'out'
    assert main([str(room), '--out', str(out), *arguments]) == 2
    assert expected in capsys.readouterr().err
    assert not out.exists()


def test_what_cannot_be_played_is_refused(tmp_path: Path, room: Path, cache: Path,
                                          capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / 'nothing').mkdir()
    (tmp_path / 'in_the_way').write_text('')
    (tmp_path / 'torn.mcap').write_bytes(b'\x89MCAP0\r\nand no more')
    out = tmp_path / 'out'
    for name, expected in (('nothing', 'is no dataset'), ('missing', 'does not exist'),
                           ('torn.mcap', 'cannot be read')):
        assert main([str(tmp_path / name), '--out', str(out)]) == 2
        message = capsys.readouterr().err
        assert name in message and expected in message and 'Traceback' not in message
    assert main([str(room), '--out', str(out), '--start', '900']) == 2
    assert f'has {FRAMES} images' in capsys.readouterr().err
    assert main([str(room), '--out', str(tmp_path / 'in_the_way')]) == 2
    assert 'cannot be written' in capsys.readouterr().err
    assert not list(out.iterdir()) and not cache.exists()
    (out / 'bag').mkdir()
    assert main([str(room), '--out', str(out), '--keep-bag']) == 2
    assert 'exists' in capsys.readouterr().err


def test_help_and_refusals_do_not_wait_for_torch() -> None:
    script = 'import sys; from aim_slam_ros.cli.demo import main; ' \
        'main(["--help"]); main(["--out", "/dev/null/x"]); ' \
        'sys.exit(any(m in sys.modules for m in ("torch", "rclpy", "matplotlib")))'
    done = subprocess.run([sys.executable, '-c', script], capture_output=True, text=True,
                          cwd=ROOT, check=False)
    assert done.returncode == 0
    assert 'DATASET' in done.stdout and 'Traceback' not in done.stderr


# Bags that are kept.

def test_a_bag_is_written_once_for_the_same_images(room: Path, tmp_path: Path,
                                                   cache: Path) -> None:
    data = shutil.copytree(room, tmp_path / 'data')

    def bag(indices: range = range(4)) -> Path:
        return cached_bag(str(data), load_sequence(data), indices)

    first = bag()
    assert is_bag(first) and first.parent == cache
    written_ns = (first / 'metadata.yaml').stat().st_mtime_ns
    assert bag() == first and (first / 'metadata.yaml').stat().st_mtime_ns == written_ns
    assert bag(range(5)) != first
    with (data / 'groundtruth.txt').open('a') as file:
        file.write('# corrected\n')
    assert bag() != first


def test_of_all_bags_the_last_few_used_are_kept(room: Path, cache: Path) -> None:
    sequence = load_sequence(room)
    first, *others = [cached_bag(str(room), sequence, range(n, n + 2)) for n in range(4)]
    assert len(list(cache.iterdir())) == 4
    cached_bag(str(room), sequence, range(0, 2))    # used again
    cached_bag(str(room), sequence, range(9, 11))
    kept = set(cache.iterdir())
    assert len(kept) == 4 and first in kept and others[0] not in kept


# Real runs.

def test_both_nodes_leave_everything(room: Path, tmp_path: Path, cache: Path) -> None:
    out = tmp_path / 'deep' / 'out'
    output, errors = process(str(room), '--out', str(out), *QUICK,
                             '--keep-bag').communicate(timeout=120)
    lines = output.splitlines()
    assert lines[-1] == str(out / 'report.png'), errors
    assert {path.name for path in out.iterdir()} == RESULTS | {'bag'} and is_bag(out / 'bag')
    figures = metrics_of(out)
    assert figures['frames_offered'] == FRAMES and figures['interrupted'] is False
    assert figures['dataset'] == 'room'
    delivered = number(figures, 'frames_delivered')
    assert delivered + number(figures, 'frames_dropped') == FRAMES
    tracked = number(figures, 'frames_tracked')
    assert 0.5 * FRAMES < tracked <= delivered
    assert 0.0 < number(figures, 'latency_ms_p50') <= number(figures, 'latency_ms_p99') \
        <= number(figures, 'latency_ms_max')
    trajectory = read_tum_trajectory(out / 'trajectory.txt')
    assert len(trajectory) == tracked and np.isfinite(trajectory.T_world_cam).all()
    truth = read_tum_trajectory(room / 'groundtruth.txt')
    # the dataset begins at 0, which is no time in ROS
    assert set((trajectory.stamps_ns - 10**9).tolist()) <= set(truth.stamps_ns.tolist())
    assert 'stamps moved by 1 s' in errors
    # far above what it reaches, far below what a wrong axis would give
    assert number(figures, 'ate_rmse_m') < 0.2 * number(figures, 'trajectory_length_m')
    assert number(figures, 'map_points') > 1000
    assert len(read_tum_trajectory(out / 'keyframes.txt')) == figures['keyframes']
    config = yaml.safe_load((out / 'config.yaml').read_text(encoding='utf-8'))
    parameters = yaml.safe_load((out / 'parameters.yaml').read_text(encoding='utf-8'))
    assert parameters['/**']['ros__parameters']['camera'] == config['camera']
    assert config['camera']['width'] == 280
    assert any(re.match(r'dropped +\d+ \(\d', line) for line in lines)
    assert any(re.match(r'latency.* \d+ / \d+ / \d+', line) for line in lines)
    assert f'{FRAMES}/{FRAMES} images' in errors and 'Traceback' not in errors
    assert 'killed' not in errors and 'still at work' not in errors


def test_a_bag_is_played_as_it_is_and_ctrl_c_writes_what_there_is(
        room: Path, tmp_path: Path, cache: Path) -> None:
    """Its topics have other names than the frontend's."""
    bag, out = tmp_path / 'recorded', tmp_path / 'out'
    write_bag(load_sequence(room), range(FRAMES), bag, BagForm(image_topic='/camera/image_raw'))
    demo = process(str(bag), '--out', str(out), *QUICK)
    assert demo.stderr is not None
    for line in demo.stderr:
        if re.search(r'images, tracked', line):
            demo.send_signal(signal.SIGINT)
            demo.send_signal(signal.SIGINT)
            break
    output, errors = demo.communicate(timeout=120)
    assert demo.returncode == 130, errors
    assert 'Traceback' not in errors
    assert {path.name for path in out.iterdir()} == RESULTS
    figures = metrics_of(out)
    assert figures['interrupted'] is True and figures['dataset'] == 'recorded'
    assert 0 < number(figures, 'frames_offered') < FRAMES
    assert number(figures, 'frames_tracked') > 0
    assert output.splitlines()[-1] == str(out / 'report.png')
    assert not cache.exists()       # nothing was converted


def test_a_node_that_dies_at_the_start_is_said_with_its_last_words(
        room: Path, tmp_path: Path, cache: Path) -> None:
    """The command line does not know that the checkpoint is missing: the nodes find out."""
    out = tmp_path / 'out'
    demo = process(str(room), '--out', str(out), *QUICK, '--model', 'vggt')
    output, errors = demo.communicate(timeout=120)
    assert demo.returncode == 1, errors
    assert 'ended by itself with status' in errors and 'error: ' in errors
    assert 'Traceback' not in errors
    assert metrics_of(out)['frames_offered'] == 0
    assert output.splitlines()[-1] == str(out / 'report.png')
