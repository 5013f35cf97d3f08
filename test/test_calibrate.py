"""The sigmas that make kappa honest, and the command that finds them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import torch

from aim_slam_ros.ablation.calibration import honest_sigmas, kappas_of, unwidened
from aim_slam_ros.cli.calibrate import main
from aim_slam_ros.config import Config
from aim_slam_ros.datasets.rendered import render
from aim_slam_ros.types import FrameResult, TrackingStatus

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope='module')
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp('data') / 'room'
    render('room', folder, frames=slice(0, 60, 3), size=(240, 180))
    return folder


def _result(kappa: float | None, keyframes: int) -> FrameResult:
    return FrameResult(1, TrackingStatus.TRACKED, torch.eye(4).double(), kappa=kappa,
                       window=tuple(range(keyframes)))


def test_a_median_of_four_doubles_the_sigma() -> None:
    config = Config().with_values({'tracking.sigma_model_px': '3'})
    assert honest_sigmas(config, [0.1, 4.0, 90.0]) == {'tracking.sigma_model_px': '6'}


def test_the_papers_tracker_has_three_sigmas() -> None:
    config = Config().with_values({'tracking.tracker': 'paper',
                                   'joint_tracking.sigma_ray': '0.01'})
    sigmas = honest_sigmas(config, [0.25])
    assert sigmas['joint_tracking.sigma_ray'] == '0.005' and len(sigmas) == 3


def test_only_windows_as_they_start_count() -> None:
    results = [_result(2.0, 2), _result(3.0, 3), _result(None, 2), _result(5.0, 1)]
    assert kappas_of(results, Config()) == [2.0]
    assert unwidened(Config()).sigma.max_window == 3
    narrow = Config().with_values({'sigma.min_window': '5', 'sigma.max_window': '4'})
    assert kappas_of(results, narrow) == [3.0], 'a window has at most that many'


def test_what_it_prints_gives_a_median_of_one(room: Path,
                                              capsys: pytest.CaptureFixture[str]) -> None:
    """The second call has the sigma that the first one found: the runs are the same."""
    command = [str(room), '--model', 'simulated', '--with-depth', '--set', 'camera.width=280',
               '--set', 'model.infer=every_image', '--set', 'keyframes.promote_below=0.9',
               '--set', 'keyframes.reuse_above=1']
    assert main(command) == 0
    first = capsys.readouterr()
    option, setting = first.out.split()
    assert option == '--set' and setting.startswith('tracking.sigma_model_px=')
    assert 'room' in first.err and 'quartiles of kappa' in first.err
    assert main([*command, option, setting]) == 0
    found, again = (float(text.split('=')[1]) for text in (setting, capsys.readouterr().out))
    assert again == pytest.approx(found, rel=0.01)      # three digits are printed


@pytest.mark.parametrize('arguments, expected', [
    (['--set', 'sigma.kapa=1'], 'did you mean sigma.kappa'),
    (['--start', '900'], 'beyond the end'),
    (['--count', '2', '--model', 'simulated'], 'too few'),
    (['--model', 'vggt'], 'model.weights')])
def test_what_cannot_be_done_is_said(room: Path, capsys: pytest.CaptureFixture[str],
                                     arguments: list[str], expected: str) -> None:
    assert main([str(room), *arguments]) == 2
    printed = capsys.readouterr()
    assert expected in printed.err and not printed.out


def test_help_does_not_wait_for_torch() -> None:
    script = 'import sys; from aim_slam_ros.cli.calibrate import main; main(["--help"]); ' \
        'sys.exit("torch" in sys.modules or "numpy" in sys.modules)'
    done = subprocess.run([sys.executable, '-c', script], capture_output=True, text=True,
                          cwd=ROOT, check=False)
    assert done.returncode == 0 and 'DATASET' in done.stdout
