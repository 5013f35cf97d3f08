"""Variants, plans, tables, the model's own poses, and short real runs side by side."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, Sequence

import numpy as np
import pytest
from clip import SIZE, Clip
from true_model import TrueModel

from aim_slam_ros import offline
from aim_slam_ros.ablation.baselines import averaged, chained
from aim_slam_ros.ablation.plan import Plan
from aim_slam_ros.ablation.runs import Images, Run, RunFolder
from aim_slam_ros.ablation.tables import Row, table
from aim_slam_ros.ablation.variants import (Comparison, Variant, VariantError, parsed_variant,
                                            read_preset)
from aim_slam_ros.cli.ablate import main
from aim_slam_ros.config import Config, ConfigError
from aim_slam_ros.datasets import load_sequence
from aim_slam_ros.datasets.rendered import render
from aim_slam_ros.evaluation.trajectory import TrajectoryError, compare
from aim_slam_ros.frontend.pipeline import FrontendPipeline
from aim_slam_ros.types import FrameEncoding, FrameResult, TrackingStatus, WindowPrediction

ROOT = Path(__file__).resolve().parents[1]
PRESET = ROOT / 'benchmark' / 'ablations.yaml'
QUICK = ['--set', 'camera.width=280']


@pytest.fixture(scope='module')
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A few frames: enough for a map, not for accuracy."""
    folder = tmp_path_factory.mktemp('data') / 'room'
    render('room', folder, frames=slice(0, 40, 2), size=SIZE)
    return folder


# Variants.

def test_a_variant_is_one_word() -> None:
    assert parsed_variant('plain') == Variant('plain') == parsed_variant('plain:')
    variant = parsed_variant('two views: sigma.min_window=2, sigma.max_window=2')
    assert variant == Variant('two views', {'sigma.min_window': '2', 'sigma.max_window': '2'})
    assert parsed_variant('c:method=chain') == Variant('c', {}, 'chain')


@pytest.mark.parametrize('text, expected', [
    (':sigma.kappa=1', 'no name'), ('a:sigma.kappa', 'section.key=value'),
    ('a:=3', 'section.key=value'), ('a:method=magic', 'slam, chain, pose_mean')])
def test_a_wrong_variant_is_refused(text: str, expected: str) -> None:
    with pytest.raises(VariantError, match=expected):
        parsed_variant(text)


def test_a_preset_reads_as_if_typed(tmp_path: Path) -> None:
    path = tmp_path / 'preset.yaml'
    path.write_text('settings: {sigma.kappa: 2}\ntables:\n  First:\n    plain:\n'
                    '    3: {loop_closure.enabled: false, sigma.voxel_fraction: 0.1}\n'
                    '  Second:\n    chain: {method: chain}\n')
    preset = read_preset(path)
    assert preset.settings == {'sigma.kappa': '2'}
    first, second = preset.comparisons
    assert first.variants[0] == Variant('plain')
    assert first.variants[1] == parsed_variant(
        '3:loop_closure.enabled=false,sigma.voxel_fraction=0.1')
    assert second == Comparison('Second', (Variant('chain', {}, 'chain'),))


@pytest.mark.parametrize('content, expected', [
    ('', 'nothing'), ('tables: 3', 'tables'), ('tables: {a: [1, 2]}', 'a'), ('{', 'not YAML'),
    ('variants: {a: }', 'variants'), ('tables: {t: }', 't: has no'),
    ('tables: {t: {a: {method: no}}}', 't: a')])
def test_a_wrong_preset_is_refused_by_name(tmp_path: Path, content: str, expected: str) -> None:
    path = tmp_path / 'preset.yaml'
    path.write_text(content)
    with pytest.raises(VariantError, match=expected) as refused:
        read_preset(path)
    assert str(path) in str(refused.value)
    with pytest.raises(VariantError, match='cannot be read'):
        read_preset(tmp_path / 'missing.yaml')


def test_the_papers_ablations_are_settings_that_exist() -> None:
    preset = read_preset(PRESET)
    plan = Plan(preset.comparisons, preset.settings, {'s': Images('s', (0,))}, 1)
    named = sum(len(comparison.variants) for comparison in preset.comparisons)
    # the default stands in several tables and is run once
    assert 15 < len(plan.runs()) < named


# Plans and tables.

def test_what_gives_the_same_is_one_run() -> None:
    """Names do not matter, nor whether a default is said; seed, images and method do."""
    images = {'a': Images('a', (0, 1)), 'b': Images('a', (0, 2))}
    default = str(Config().sigma.kappa)
    plan = Plan((Comparison('x', (Variant('one'), Variant('two', {'sigma.kappa': default}))),
                 Comparison('y', (Variant('three', {}, 'chain'),))), {}, images, 2)
    assert len(plan.runs()) == 2 * 2 * 2
    assert len({run.key for run in plan.runs()}) == 8
    assert [run.config.seed for run in plan.runs()] == [0] * 4 + [1] * 4
    assert plan.described(plan.runs()[0]) == 'a, one, seed 0'


def test_a_variant_wins_over_what_all_have() -> None:
    plan = Plan((Comparison('x', (Variant('v', {'sigma.kappa': '2'}),)),),
                {'sigma.kappa': '3', 'sigma.max_window': '4'}, {'a': Images('a', ())}, 1)
    sigma = plan.runs()[0].config.sigma
    assert (sigma.kappa, sigma.max_window) == (2.0, 4)
    with pytest.raises(ConfigError, match="'bad'.*did you mean sigma.kappa"):
        Plan((Comparison('x', (Variant('bad', {'sigma.kapa': '1'}),)),), {}, {}, 1)


def test_cells_hold_mean_deviation_and_what_is_missing() -> None:
    def figures(ate: float | None, tracked: int) -> dict[str, float | int | None]:
        return {'ate_rmse_m': ate, 'frames_tracked': tracked, 'frames_offered': 10, 'loops': 1}
    text = table('Title', [
        Row('all', {'s': [figures(0.01, 10), figures(0.03, 10)]}),
        Row('some', {'s': [figures(0.01, 10), figures(None, 2)]}),
        Row('none', {'s': [None, None]})], ('loops',))
    assert text.splitlines() == [
        '### Title', '',
        '|  | s: ATE RMSE [m] | s: tracked | s: loops |',
        '| --- | ---: | ---: | ---: |',
        '| all | 0.0200 ± 0.0141 | 10 / 10 | 1 ± 0 |',
        '| some | 0.0100 (1 of 2) | 6 ± 5.7 / 10 | 1 ± 0 |',
        '| none | failed | – | – |']


def test_figures_come_back_and_damaged_ones_do_not(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / 'runs')
    run = Run(Images('a', (1, 2)), Config(), 'slam')
    assert folder.figures(run) is None
    folder.write(run, {'ate_rmse_m': float('nan'), 'loops': 2})
    assert folder.figures(run) == {'ate_rmse_m': None, 'loops': 2}
    file, = (tmp_path / 'runs').iterdir()
    file.write_text(file.read_text()[:20])
    assert folder.figures(run) is None


# The model's own poses.

class OneWrongView(TrueModel):
    """Puts the third view of a window one metre too far to the right."""

    def infer(self, encodings: Sequence[FrameEncoding]) -> WindowPrediction:
        prediction = super().infer(encodings)
        if len(encodings) > 2:
            unit = float(self._clip.depth_of(encodings[0].features)[0, 0]
                         / prediction.depth[0, 0, 0])
            prediction.T_first_cam[2, 0, 3] += 1.0 / unit
        return prediction


CALIBRATED = {'camera.width': '322', 'camera.use_calibration': 'true',
              'keyframes.promote_below': '0.9'}     # several keyframes in a short clip


def through(frontend: offline.Frontend, clip: Clip) -> list[float]:
    """How far each pose is from the truth [m]; the first frame is the world."""
    errors = []
    for index in range(0, len(clip), 3):
        result = frontend.process(clip.stamps_ns[index], clip.images[index], clip.K)
        assert result.status is TrackingStatus.TRACKED, result.reason
        assert result.T_world_cam is not None
        unit = float(frontend.keyframes[0].points_cam[100, 100, 2] / clip.depth_of(0)[100, 100])
        T_true = clip.T_a_b(0, index)
        errors.append(float((result.T_world_cam[:3, 3] / unit - T_true[:3, 3]).norm()))
    return errors


def test_a_keyframe_of_nonsense_does_not_end_a_run(
        tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    render('room', tmp_path / 'room', frames=slice(0, 60, 3), size=SIZE)
    sequence = load_sequence(tmp_path / 'room')

    class Nonsense(FrontendPipeline):
        def process(self, *args: Any) -> FrameResult:
            result = super().process(*args)
            return replace(result, events=tuple(
                replace(e, T_world_kf=e.T_world_kf * np.nan) if e.keyframe_id == 1 else e
                for e in result.events))

    config = Config().with_values({'camera.width': '280'})
    run = offline.run(sequence, config, range(len(sequence)), make_frontend=Nonsense)
    assert len(run.results) == len(sequence) and len(run.keyframes) > 1
    assert any('keyframe 1 is not used' in message for message in caplog.messages)


def test_a_model_that_fails_late_leaves_what_there_was(
        room: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Out of memory at the last of many images: the others are a result."""
    class Failing(FrontendPipeline):
        def process(self, stamp_ns: int, image: np.ndarray,
                    K: np.ndarray | None = None) -> FrameResult:
            if len(done) == left:
                raise RuntimeError('out of memory')
            done.append(stamp_ns)
            return super().process(stamp_ns, image, K)

    sequence, done, left = load_sequence(room), list[int](), 5
    config = Config().with_values({'camera.width': '280'})
    run = offline.run(sequence, config, range(len(sequence)), make_frontend=Failing)
    assert run.interrupted and len(run.results) == 5
    assert 'after 5 images' in caplog.text and 'out of memory' in caplog.text
    done, left = [], 0
    with pytest.raises(RuntimeError, match='out of memory'):
        offline.run(sequence, config, range(len(sequence)), make_frontend=Failing)


def test_both_baselines_follow_a_model_that_is_right(clip: Clip) -> None:
    """Through the unit of every window. The depths of two inferences differ by float32 only."""
    config = Config().with_values(CALIBRATED)
    for make_frontend in (chained, averaged):
        model = TrueModel(clip)
        frontend = make_frontend(config, model)
        assert max(through(frontend, clip)) < 1e-4
        assert len(frontend.keyframes) > 3 and model.widest == config.sigma.max_window


def test_a_chain_hears_the_image_before_only_a_mean_all_keyframes(clip: Clip) -> None:
    config = Config().with_values(CALIBRATED)
    assert max(through(chained(config, OneWrongView(clip)), clip)) < 1e-4
    # one of at most four keyframes errs by a metre
    assert max(through(averaged(config, OneWrongView(clip)), clip)) > 0.1


def test_a_baseline_with_two_views_waits_for_depth_and_can_be_measured(room: Path) -> None:
    """The classical model needs parallax; what comes out is a run like any other."""
    sequence = load_sequence(room)
    config = Config().with_values({'camera.width': '280', 'loop_closure.enabled': 'false'})
    run = offline.run(sequence, config, range(len(sequence)), make_frontend=averaged)
    statuses = [result.status for result in run.results]
    assert statuses[0] is TrackingStatus.INITIALISING and TrackingStatus.TRACKED in statuses
    assert len(run.map_cloud.points) > 1000 and run.keyframes
    assert sequence.groundtruth is not None
    error = compare(run.trajectory, sequence.groundtruth)
    assert isinstance(error, TrajectoryError) and np.isfinite(error.ate_rmse_m)


# The command.

@pytest.mark.parametrize('arguments, expected', [
    ([], 'nothing to compare'),
    (['--variant', 'a:sigma.kapa=1'], 'did you mean sigma.kappa'),
    (['--variant', 'a:method=magic'], 'slam, chain, pose_mean'),
    (['--variant', 'a', '--seeds', '0'], 'at least 1'),
    (['--variant', 'a', '--model', 'magic'], 'one of classical'),
    (['--preset', 'missing.yaml'], 'cannot be read'),
    (['--variant', 'a', '--start', '900'], 'beyond the end')])
def test_what_cannot_be_done_is_refused_before_the_work(
        room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str],
        expected: str) -> None:
    assert main(['--sequences', str(room), '--out', str(tmp_path / 'out'), *arguments]) == 2
    assert expected in capsys.readouterr().err
    assert not list(tmp_path.rglob('*.json'))


def test_help_does_not_wait_for_torch() -> None:
    script = 'import sys; from aim_slam_ros.cli.ablate import main; main(["--help"]); ' \
        'sys.exit("torch" in sys.modules or "numpy" in sys.modules)'
    done = subprocess.run([sys.executable, '-c', script], capture_output=True, text=True,
                          cwd=ROOT, check=False)
    assert done.returncode == 0 and 'NAME:SETTINGS' in done.stdout


def test_runs_are_done_once_and_printed(room: Path, tmp_path: Path,
                                        capsys: pytest.CaptureFixture[str]) -> None:
    """Two variants and a baseline, two of them at a time; then one more variant."""
    command = ['--sequences', str(room), '--out', str(tmp_path), '--seeds', '1', '--jobs', '2',
               '--variant', 'plain', '--variant', 'same:sigma.max_window=5', '--variant',
               'mean:method=pose_mean', *QUICK]
    assert main(command) == 0
    printed = capsys.readouterr()
    assert printed.out == (tmp_path / 'tables.md').read_text(encoding='utf-8')
    rows = {line.split('|')[1].strip(): line for line in printed.out.splitlines()
            if line.startswith('| ')}
    assert rows['plain'].replace('plain', 'same') == rows['same'] and '/ 20' in rows['mean']
    assert '2/2 after' in printed.err
    files = {path: path.stat().st_mtime_ns for path in (tmp_path / 'runs').iterdir()}
    assert len(files) == 2
    assert main([*command, '--variant', 'wide:sigma.max_window=4']) == 0
    assert '1/1 after' in capsys.readouterr().err
    assert all(path.stat().st_mtime_ns == then for path, then in files.items())


def test_a_run_that_fails_is_said_and_tried_again(room: Path, tmp_path: Path,
                                                  capfd: pytest.CaptureFixture[str]) -> None:
    """The network without its weights."""
    command = ['--sequences', str(room), '--out', str(tmp_path), '--seeds', '1',
               '--variant', 'network:model.name=vggt']
    for _ in range(2):
        assert main(command) == 1
        printed = capfd.readouterr()
        assert '1/1 after' in printed.err and 'exit status 2' in printed.err
        assert 'Traceback' not in printed.err and 'model.weights' in printed.err
        assert '| network | failed | – |' in printed.out
        assert not list((tmp_path / 'runs').iterdir())


def test_ctrl_c_ends_every_process_and_keeps_what_was_finished(room: Path,
                                                               tmp_path: Path) -> None:
    command = [sys.executable, '-m', 'aim_slam_ros.cli.ablate', '--sequences', str(room), '--out',
               str(tmp_path), '--variant', 'a', '--seeds', '50', '--jobs', '2', *QUICK]
    process = subprocess.Popen(
        command, cwd=ROOT, env=os.environ | {'PYTHONPATH': str(ROOT)}, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True,
        # a shell starts background jobs, and so this test, with SIGINT ignored
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL))
    assert process.stderr is not None
    for line in process.stderr:
        if line.startswith('1/50'):
            os.killpg(process.pid, signal.SIGINT)   # as a terminal sends it: to all of them
            break
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors
    assert 'Traceback' not in errors and 'goes on from here' in errors
    assert 1 <= len(list((tmp_path / 'runs').glob('*.json'))) < 50
    deadline = time.monotonic() + 10.0
    while group_lives(process.pid) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not group_lives(process.pid)


def group_lives(pid: int) -> bool:
    try:
        os.killpg(pid, 0)
    except ProcessLookupError:
        return False
    return True
