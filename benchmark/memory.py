"""Is memory bounded by the place or by time? Both pipelines, long in one room.

    .venv/bin/python benchmark/memory.py --out FOLDER [--images 10000]

The rendered room's path there and back, again and again, with a model that knows the scene's
geometry (benchmark/frontend.py). Keyframes and the process's memory are taken after every tenth of
the images, and before the first one: what the scene's known depths and the libraries take, which
differs by some 300 MB from process to process as the allocator happens to lay them out. One figure
a line; adds to benchmark.json.
"""

from __future__ import annotations

import gc
import time
from dataclasses import dataclass

from figures import Figures, add, parser, said
from frontend import KnownGeometry
from torch import Tensor

from aim_slam_ros.config import Config
from aim_slam_ros.datasets import load_sequence
from aim_slam_ros.datasets.base import Sequence
from aim_slam_ros.frontend.pipeline import FrontendPipeline
from aim_slam_ros.loop_closure.pipeline import LoopClosurePipeline
from aim_slam_ros.nodes.memory import memory_mb
from aim_slam_ros.types import TrackingStatus

PARTS = 10
BEGIN_NS, STEP_NS = 10 ** 15, 33_333_333     # none of the sequence's own stamps


@dataclass(frozen=True)
class Part:
    """After a tenth of the images."""

    tracked: int
    keyframes: int
    memory_mb: float


class _Repeated(dict[int, Tensor]):
    """What is known of a sequence's images, by the stamps of a path that is walked for ever."""

    def __init__(self, known: dict[int, Tensor], path: list[int]) -> None:
        super().__init__(known)
        self._path = path       # stamps of the sequence

    def __missing__(self, stamp_ns: int) -> Tensor:
        return self[self._path[(stamp_ns - BEGIN_NS) // STEP_NS % len(self._path)]]


def main() -> int:
    arguments = parser(__doc__)
    arguments.add_argument('--images', type=int, default=10000)
    args = arguments.parse_args()
    if args.images < PARTS:
        arguments.error(f'--images {args.images}: at least {PARTS}')
    sequence = load_sequence('rendered:room')
    start = time.perf_counter()
    before, *parts = _walk(sequence, args.images)
    seconds = time.perf_counter() - start
    half, last = parts[PARTS // 2 - 1], parts[-1]
    figures: Figures = said({
        'long_run_images': args.images,
        'long_run_tracked_percent': 100.0 * sum(p.tracked for p in parts) / args.images,
        'long_run_rate_hz': args.images / seconds,
        'long_run_keyframes_at_half': half.keyframes, 'long_run_keyframes': last.keyframes,
        'long_run_memory_mb_before': before.memory_mb,
        'long_run_memory_mb_at_half': half.memory_mb, 'long_run_memory_mb': last.memory_mb})
    args.out.mkdir(parents=True, exist_ok=True)
    add(args.out, figures)
    return 0


def _walk(sequence: Sequence, count: int) -> list[Part]:
    """There and back through the room; first how it was before."""
    there = list(range(len(sequence)))
    path = there + there[-2:0:-1]
    stamps_ns = [int(sequence.stamps_ns[index]) for index in path]
    config, model = Config(), KnownGeometry(sequence, len(sequence))
    model.T_world_cam = _Repeated(model.T_world_cam, stamps_ns)
    model._depth = _Repeated(model._depth, stamps_ns)
    frontend, loops = FrontendPipeline(config, model), LoopClosurePipeline(config, model)
    gc.collect()
    parts, tracked = [Part(0, 0, memory_mb())], 0
    for k in range(count):
        result = frontend.process(BEGIN_NS + k * STEP_NS, sequence.image(path[k % len(path)]))
        tracked += result.status is TrackingStatus.TRACKED
        for event in result.events:
            correction = loops.add(event)
            if correction is not None:
                frontend.apply_correction(correction)
        if (k + 1) * PARTS // count > k * PARTS // count:
            gc.collect()
            parts.append(Part(tracked, len(frontend.keyframes), memory_mb()))
            print(f'# {k + 1} images: {parts[-1]}', flush=True)
            tracked = 0
    return parts


if __name__ == '__main__':
    raise SystemExit(main())
