"""benchmark/vggt.py: what it prints and when it fails."""

from __future__ import annotations

import importlib.util
import json
import shutil
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from vggt_tiny import fixture_path


@pytest.fixture(scope='module')
def benchmark() -> ModuleType:
    path = Path(__file__).resolve().parents[1] / 'benchmark' / 'vggt.py'
    sys.path.append(str(path.parent))   # its neighbour figures.py
    spec = importlib.util.spec_from_file_location('benchmark_vggt', path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module     # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def _figures(out: str) -> dict[str, float]:
    return {name: float(value) for name, value in
            (line.split(': ') for line in out.splitlines())}


def test_speed(benchmark: ModuleType, tmp_path: Path,
               capsys: pytest.CaptureFixture[str]) -> None:
    assert benchmark.main(['--size', 'tiny', '--views', '3', '--out', str(tmp_path)]) == 0
    figures = _figures(capsys.readouterr().out)
    assert figures['vggt_tiny_3views_2cached_difference'] < 1e-5
    # Two of three patch embeddings and depth heads are spared; how long that takes is not tested.
    assert figures['vggt_tiny_3views_2cached_flop_ratio'] > 1.3
    assert figures['vggt_tiny_3views_2cached_cpu_s'] > 0
    assert figures.keys() == json.loads((tmp_path / 'benchmark.json').read_text()).keys()


def test_the_full_size_spares_a_quarter_of_its_operations(benchmark: ModuleType) -> None:
    """Counted, not computed. The official code needs 7.94 TFLOP for three views; ours has the last
    layer of each fusion before it resizes: 66038 pixels fewer a view, 2 x 256 x 256 each.
    """
    case = benchmark.SIZES['full']
    without, cached = (benchmark._flops(case, 3, path) / 1e12
                       for path in (benchmark._without_cache, benchmark._with_cache))
    spared = 3 * 66038 * 2 * 256 ** 2 / 1e12
    assert without == pytest.approx(7.943 - spared, abs=0.002)
    assert without / cached == pytest.approx(1.35, abs=0.01)


def test_one_view_has_nothing_to_spare(benchmark: ModuleType) -> None:
    assert benchmark.main(['--size', 'tiny', '--views', '1']) == 0


def test_parity(benchmark: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    assert benchmark.main(['--parity', str(fixture_path('tiny'))]) == 0
    figures = _figures(capsys.readouterr().out)
    assert len(figures) == 15 and max(figures.values()) < 1e-5


@pytest.mark.parametrize('wrong', ['a number', 'a shape', 'an unknown array'])
def test_a_fixture_that_is_not_matched(benchmark: ModuleType, tmp_path: Path, wrong: str) -> None:
    folder = fixture_path('tiny')
    for name in ('meta.json', 'inputs.npy', 'weights.safetensors'):
        shutil.copyfile(folder / name, tmp_path / name)
    arrays = dict(np.load(folder / 'outputs.npz'))
    if wrong == 'a number':
        arrays['depth'][1, 20, 30] += 2e-5
    elif wrong == 'a shape':
        arrays['depth'] = arrays['depth'][..., 0]
    else:
        arrays['unheard_of'] = arrays['depth']
    np.savez(tmp_path / 'outputs.npz', **arrays)
    assert benchmark.main(['--parity', str(tmp_path)]) == 1
