"""The command line: what is refused and when, and short real runs on a rendered room."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from aim_slam_ros.cli.evaluate import main
from aim_slam_ros.datasets.rendered import render
from aim_slam_ros.datasets.text import read_tum_trajectory

ROOT = Path(__file__).resolve().parents[1]
FILES = {'trajectory.txt', 'keyframes.txt', 'map.ply', 'config.yaml', 'metrics.json',
         'report.png'}
FRAMES = 32
QUICK = ['--set', 'camera.width=280']     # half the default: these tests are not about accuracy


@pytest.fixture(scope='module')
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Every second frame of the rendered room's beginning."""
    folder = tmp_path_factory.mktemp('data') / 'room'
    render('room', folder, frames=slice(0, 2 * FRAMES, 2), size=(320, 240))
    return folder


def metrics_of(folder: Path) -> dict[str, object]:
    return json.loads((folder / 'metrics.json').read_text(encoding='utf-8'))


def lines_of(path: Path) -> list[str]:
    return path.read_text(encoding='utf-8').splitlines()


# What is refused, before any work.

@pytest.mark.parametrize('arguments, expected', [
    (['--stride', '0'], 'at least 1'),
    (['--stride', 'two'], 'at least 1'),
    (['--count', '0'], 'at least 1'),
    (['--start', '-1'], 'at least 0'),
    (['--seed', '-1'], 'from 0 to 2147483647'),
    (['--seed', 'x'], 'from 0 to 2147483647'),
    (['--model', 'magic'], 'one of classical'),
    (['--set', 'camera.width=7'], 'from 84 to 1036'),
    (['--set', 'camera.wdith=392'], 'did you mean camera.width'),
    (['--set', 'camera.width'], 'section.name=value'),
    (['--set', 'loop_closure.enabled=perhaps'], 'true or false'),
    (['--turbo'], '--turbo'),
])
def test_a_wrong_option_is_refused_with_what_is_allowed(
        room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str],
        expected: str) -> None:
    out = tmp_path / 'out'
    assert main([str(room), '--out', str(out), *arguments]) == 2
    assert expected in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.parametrize('name', ['a_file', 'a_file/below'])
def test_an_output_folder_that_cannot_be_written_is_refused_first(
        tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str) -> None:
    """Before the dataset is even looked at. Permissions would not bind where root runs this."""
    (tmp_path / 'a_file').write_text('in the way')
    assert main(['no such dataset', '--out', str(tmp_path / name)]) == 2
    message = capsys.readouterr().err
    assert str(tmp_path / name) in message and 'cannot be written' in message
    assert (tmp_path / 'a_file').read_text() == 'in the way'


def test_what_is_no_dataset_is_refused(tmp_path: Path, room: Path,
                                       capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / 'nothing').mkdir()
    (tmp_path / 'empty').mkdir()
    (tmp_path / 'empty' / 'rgb.txt').write_text('# no images\n')
    out = tmp_path / 'out'
    for name, expected in (('nothing', 'is no dataset'), ('empty', 'it is empty'),
                           ('missing', 'does not exist')):
        assert main([str(tmp_path / name), '--out', str(out)]) == 2
        message = capsys.readouterr().err
        assert name in message and expected in message
    assert main([str(room), '--out', str(out), '--start', '900']) == 2
    assert f'has {FRAMES} images' in capsys.readouterr().err
    assert not list(out.iterdir())


def test_help_and_refusals_do_not_wait_for_torch() -> None:
    script = 'import sys; from aim_slam_ros.cli.evaluate import main; ' \
        'main(["--help"]); main(["x", "--out", "/dev/null/x"]); ' \
        'sys.exit("torch" in sys.modules or "matplotlib" in sys.modules)'
    done = subprocess.run([sys.executable, '-c', script], capture_output=True, text=True,
                          cwd=ROOT, check=False)
    assert done.returncode == 0
    assert 'DATASET' in done.stdout and 'Traceback' not in done.stderr


def test_settings_are_listed_with_their_ranges(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['--list-settings']) == 0
    text = capsys.readouterr().out
    assert 'camera.width = 518' in text and 'from 84 to 1036' in text


# Real runs.

def test_a_run_writes_everything(room: Path, tmp_path: Path,
                                 capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / 'deep' / 'out'
    assert main([str(room), '--out', str(out), '--seed', '3', *QUICK]) == 0
    assert {path.name for path in out.iterdir()} == FILES
    figures = metrics_of(out)
    assert figures['frames_offered'] == FRAMES and figures['seed'] == 3
    assert figures['interrupted'] is False and figures['dataset'] == 'room'
    tracked = figures['frames_tracked']
    assert isinstance(tracked, int) and tracked > FRAMES // 2
    trajectory = read_tum_trajectory(out / 'trajectory.txt')
    assert len(trajectory) == tracked and np.isfinite(trajectory.T_world_cam).all()
    truth = read_tum_trajectory(room / 'groundtruth.txt')
    assert set(trajectory.stamps_ns.tolist()) <= set(truth.stamps_ns.tolist())
    error, moved = figures['ate_rmse_m'], figures['trajectory_length_m']
    assert isinstance(error, float) and isinstance(moved, float) and error < moved
    config = yaml.safe_load((out / 'config.yaml').read_text(encoding='utf-8'))
    assert config['seed'] == 3 and config['camera']['width'] == 280
    points = re.search(rb'element vertex (\d+)', (out / 'map.ply').read_bytes())
    assert points is not None and int(points[1]) > 1000
    printed = capsys.readouterr()
    assert printed.out.splitlines()[-1] == str(out / 'report.png')
    assert f'{FRAMES}/{FRAMES} images' in printed.err


def test_bad_images_are_named_counted_and_skipped(room: Path, tmp_path: Path,
                                                  capsys: pytest.CaptureFixture[str]) -> None:
    """Missing, empty, black, differently sized and tiny images, without ground truth."""
    data, out = tmp_path / 'data', tmp_path / 'out'
    shutil.copytree(room, data)
    (data / 'groundtruth.txt').unlink()
    images = sorted((data / 'rgb').iterdir())
    images[5].unlink()
    images[9].write_bytes(b'')
    cv2.imwrite(str(images[12]), np.zeros((240, 320, 3), np.uint8))
    cv2.imwrite(str(images[15]), cv2.imread(str(images[15]))[:160, :200])
    cv2.imwrite(str(images[18]), np.full((4, 4, 3), 90, np.uint8))
    assert main([str(data), '--out', str(out), '--no-loop-closure', *QUICK]) == 0
    figures = metrics_of(out)
    assert figures['frames_unreadable'] == 2
    assert figures['frames_offered'] == FRAMES
    skipped = figures['frames_skipped']
    assert isinstance(skipped, int) and skipped >= 2
    assert figures['ate_rmse_m'] is None and figures['trajectory_length_m'] is None
    assert figures['loops'] == 0
    assert {path.name for path in out.iterdir()} == FILES
    printed = capsys.readouterr().out
    assert images[5].name in printed and images[9].name in printed
    assert 'no ground truth' in printed


def test_stride_start_and_count_choose_the_images(room: Path, tmp_path: Path) -> None:
    assert main([str(room), '--out', str(tmp_path), '--start', '2', '--count', '7',
                 '--stride', '3', *QUICK]) == 0
    assert metrics_of(tmp_path)['frames_offered'] == 3     # 2, 5 and 8
    assert {path.name for path in tmp_path.iterdir()} == FILES


def test_the_same_run_gives_the_same_poses(room: Path, tmp_path: Path) -> None:
    paths = []
    for name in ('a', 'b'):
        assert main([str(room), '--out', str(tmp_path / name), '--count', '16', *QUICK]) == 0
        paths.append(lines_of(tmp_path / name / 'trajectory.txt'))
    assert paths[0] == paths[1]


def test_ctrl_c_writes_what_there_is(room: Path, tmp_path: Path) -> None:
    """A real process and a real signal, once a few images are through."""
    process = subprocess.Popen(
        [sys.executable, '-m', 'aim_slam_ros.cli.evaluate', str(room), '--out', str(tmp_path),
         *QUICK], cwd=ROOT, env=os.environ | {'PYTHONPATH': str(ROOT)}, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        # a shell starts background jobs, and so this test, with SIGINT ignored
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL))
    assert process.stderr is not None
    for line in process.stderr:
        if 'images, ' in line:
            process.send_signal(signal.SIGINT)
            break
    output, errors = process.communicate(timeout=120)
    assert process.returncode == 130, errors
    assert 'Traceback' not in errors
    assert {path.name for path in tmp_path.iterdir()} == FILES
    figures = metrics_of(tmp_path)
    assert figures['interrupted'] is True
    offered = figures['frames_offered']
    assert isinstance(offered, int) and 0 < offered < FRAMES
    assert output.splitlines()[-1] == str(tmp_path / 'report.png')
