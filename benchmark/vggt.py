"""VGGT: is it the official network, and what does its cache save?

    .venv/bin/python benchmark/vggt.py --parity FOLDER
    .venv/bin/python benchmark/vggt.py [--views 3] [--size full|tiny] [--repeat 2] [--threads 1]

--parity compares every array of FOLDER's outputs.npz (weights and sizes beside it) in three ways:
all views at once, each view prepared by itself as the cache does, and with the views after the
first in reverse order; it prints the largest relative difference, max |a-b| / max |b|.
Otherwise: random weights, float32, on the CPU; a window of which all but the newest image are
keyframes whose tokens are cached and only the newest image's depth is asked for, against the same
network without a cache and, where it can be imported as `vggt`, against the official code. The
full size needs 8 GB of memory and some minutes.
One figure a line, ``name: number``. Exit status 1 where outputs differ.
"""

from __future__ import annotations

import argparse
import ctypes
import importlib
import re
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Callable, Sequence

import torch
from figures import Figures, add
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from aim_slam_ros.models.vggt.aggregator import Grid
from aim_slam_ros.models.vggt.loading import empty_network
from aim_slam_ros.models.vggt.network import Vggt, VggtOutput
from aim_slam_ros.models.vggt.parity import begun, compare, difference
from aim_slam_ros.models.vggt.sizes import PATCH_PX, VggtSizes
from aim_slam_ros.models.vggt.synthetic import TINY, random_network

SAME = 1e-5             # of a fixture's arrays, and of our own two paths
# The official code adds up in another order: through 72 blocks and an exponential float32 rounding
# (6e-8) may grow some hundred times.
SAME_AS_OFFICIAL = 1e-4


@dataclass(frozen=True)
class Size:
    sizes: VggtSizes
    height: int
    width: int


Timed = Callable[[], VggtOutput]

SIZES = {
    'full': Size(VggtSizes(), 392, 518),
    'tiny': Size(TINY, 84, 112)}


@dataclass(frozen=True)
class Run:
    """What a path gave and what it took."""

    output: VggtOutput
    cpu_s: float
    peak_gb: float | None


def main(argv: Sequence[str] | None = None) -> int:
    args = _parser().parse_args(argv)
    torch.set_num_threads(args.threads)
    figures = parity(args.parity) if args.parity else speed(args.size, args.views, args.repeat)
    for name, value in figures.items():
        shown = 'none' if value is None else f'{value:.4g}'
        print(f'{name}: {shown}', flush=True)
    if args.out:
        args.out.mkdir(parents=True, exist_ok=True)
        add(args.out, figures)
    return 0 if same(figures) else 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--parity', type=Path, metavar='FOLDER')
    parser.add_argument('--views', type=int, default=3, choices=range(1, 21), metavar='N')
    parser.add_argument('--size', choices=SIZES, default='full')
    parser.add_argument('--repeat', type=int, default=2, metavar='N',
                        help='take the least of so many runs of each path; the first is cold')
    parser.add_argument('--threads', type=int, default=1, metavar='N')
    parser.add_argument('--out', type=Path, metavar='FOLDER', help='add to benchmark.json there')
    return parser


def same(figures: Figures) -> bool:
    """Whether there are differences, and each is within its bound."""
    bounds = {'_difference': SAME, '_difference_to_official': SAME_AS_OFFICIAL}
    within = [value is not None and value <= bound for name, value in figures.items()
              for ending, bound in bounds.items() if name.endswith(ending)]
    return bool(within) and all(within)


def parity(folder: Path) -> Figures:
    """The largest relative difference of each array."""
    return {f'vggt_parity_{name}_difference': value for name, value in compare(folder).items()}


def speed(size: str, views: int, repeat: int) -> Figures:
    """Seconds, operations and memory of the paths, and how far apart their outputs are."""
    case, name = SIZES[size], f'vggt_{"" if size == "full" else size + "_"}{views}views'
    cached = f'{name}_{views - 1}cached'
    network = random_network(case.sizes)
    images = torch.rand(views, 3, case.height, case.width,
                        generator=torch.Generator().manual_seed(1))
    cache = _cache(network, images)
    paths: dict[str, Timed] = {'cached': lambda: _with_cache(network, images, cache),
                               'uncached': lambda: _without_cache(network, images, cache)}
    official = official_network(network) if size == 'full' else None
    if official is not None:
        paths['official'] = lambda: _official_output(official, images)
    _give_back_memory()     # the weights that the official code drew for itself
    best = _best_of(paths, repeat)
    ours, without = best['cached'], best['uncached']
    flops, flops_without = (_flops(case, views, path) for path in (_with_cache, _without_cache))
    figures: Figures = {
        f'{name}_uncached_cpu_s': without.cpu_s, f'{cached}_cpu_s': ours.cpu_s,
        f'{cached}_speedup': without.cpu_s / ours.cpu_s,
        f'{name}_uncached_tflop': flops_without / 1e12, f'{cached}_tflop': flops / 1e12,
        f'{cached}_flop_ratio': flops_without / flops,
        f'{name}_uncached_peak_gb': without.peak_gb, f'{cached}_peak_gb': ours.peak_gb,
        f'{cached}_difference': _apart(ours.output, without.output)}
    if 'official' in best:
        theirs = best['official']
        figures |= {f'{name}_official_cpu_s': theirs.cpu_s,
                    f'{name}_official_peak_gb': theirs.peak_gb,
                    f'{cached}_speedup_against_official': theirs.cpu_s / ours.cpu_s,
                    f'{cached}_difference_to_official': _apart(ours.output, theirs.output)}
    return figures


def _cache(network: Vggt, images: Tensor) -> Tensor:
    """[N-1,T,C]: what the model keeps of the keyframes, all images but the first."""
    grid = _grid(images)
    return torch.cat([network.begin(network.encode(image[None]), grid, False)
                      for image in images[1:]] or [images.new_empty(0)])


def _with_cache(network: Vggt, images: Tensor, cache: Tensor) -> VggtOutput:
    grid = _grid(images)
    newest = network.begin(network.encode(images[:1]), grid, True)
    views = torch.cat([newest, cache]) if len(images) > 1 else newest
    return network(views, grid, depth_views=(0,))


def _without_cache(network: Vggt, images: Tensor, cache: Tensor) -> VggtOutput:
    grid = _grid(images)
    return network(begun(network, network.encode(images), grid), grid)


def _best_of(paths: dict[str, Timed], repeat: int) -> dict[str, Run]:
    """Of each the least CPU time and the least memory of its runs: other work only adds to them.

    In turns: a machine that gets faster or slower meanwhile does so for all of them.
    """
    rounds = [{name: _run(path) for name, path in paths.items()} for _ in range(max(1, repeat))]
    return {name: _best([done[name] for done in rounds]) for name in paths}


def _best(runs: Sequence[Run]) -> Run:
    peaks = [run.peak_gb for run in runs if run.peak_gb is not None]
    return Run(runs[0].output, min(run.cpu_s for run in runs), min(peaks, default=None))


def _run(path: Timed) -> Run:
    measurable = _forget_peak()
    start = time.process_time()
    output = path()
    return Run(output, time.process_time() - start, _peak_gb() if measurable else None)


def _grid(images: Tensor) -> Grid:
    return Grid(images.shape[-2] // PATCH_PX, images.shape[-1] // PATCH_PX)


def _give_back_memory() -> None:
    """What is free in the allocator would count in the peaks (glibc)."""
    trim = getattr(ctypes.CDLL(None), 'malloc_trim', None)
    if trim is not None:
        trim(0)


def _forget_peak() -> bool:
    """Let the kernel count the process's largest memory anew, where it can (Linux)."""
    try:
        Path('/proc/self/clear_refs').write_text('5', encoding='ascii')
    except OSError:
        return False
    return True


def _peak_gb() -> float | None:
    status = Path('/proc/self/status').read_text(encoding='ascii')
    found = re.search(r'VmHWM:\s+(\d+) kB', status)
    return int(found[1]) * 1024 / 1e9 if found else None


def _flops(case: Size, views: int, path: Callable[[Vggt, Tensor, Tensor], VggtOutput]) -> int:
    """Multiplications and additions, counted without computing anything."""
    network = empty_network(case.sizes)
    images = torch.empty(views, 3, case.height, case.width, device='meta')
    cache = _cache(network, images)
    with FlopCounterMode(display=False) as counter:
        path(network, images, cache)
    return counter.get_total_flops()


def _apart(a: VggtOutput, b: VggtOutput) -> float:
    """Largest relative difference of the poses and of the views whose depth both have."""
    n = min(len(a.depth), len(b.depth))
    pairs = [(a.pose_rounds[-1], b.pose_rounds[-1]), (a.depth[:n], b.depth[:n]),
             (a.confidence[:n], b.confidence[:n])]
    return max(difference(x, y) for x, y in pairs)


def official_network(network: Vggt) -> nn.Module | None:
    """The official implementation with the same weights, where it is installed."""
    here = str(Path(__file__).resolve().parent)
    path, sys.path = sys.path, [p for p in sys.path if p and str(Path(p).resolve()) != here]
    # This very file is called vggt too.
    if getattr(sys.modules.get('vggt'), '__file__', None) == __file__:
        del sys.modules['vggt']
    try:
        module = importlib.import_module('vggt.models.vggt')
    except ImportError as error:
        print(f'# the official code is not measured: {error}', file=sys.stderr)
        return None
    finally:
        sys.path = path
    official = module.VGGT()
    official.point_head = official.track_head = None
    official.load_state_dict(network.state_dict(), assign=True)
    return official.requires_grad_(False).eval()


def _official_output(official: nn.Module, images: Tensor) -> VggtOutput:
    with torch.no_grad():
        out = official(images)
    return VggtOutput([out['pose_enc'][0]], out['depth'][0, ..., 0], out['depth_conf'][0], {})


if __name__ == '__main__':
    sys.exit(main())
