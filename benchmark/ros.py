"""What ROS costs: the nodes against the same pipelines without it, latency, message overhead.

    .venv/bin/python benchmark/ros.py --data FOLDER --out FOLDER [--only NAME ...]

recordings: tum_fr1_xyz and redkitchen_600 of FOLDER through both nodes over DDS at RATE times real
time, against `evaluate` on the same images. slow_model: tum_fr1_xyz at 10 Hz with a model that
takes a second for each inference. messages: what converting and sending them takes.
Adds to benchmark.json: ``name: number``, the unit in the name.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, Callable

import numpy as np
import torch
from figures import Figures, add, parser, said
from rclpy.serialization import deserialize_message, serialize_message

from aim_slam_ros.types import KeyframeEvent
from msg_adapters import encodings, images, keyframes

RATE = 0.3              # 9 images per second: what two cores manage for every image
SLOW_RATE = 1.0
RECORDINGS = ('tum_fr1_xyz', 'redkitchen_600')
PARTS = ('messages', 'slow_model', *RECORDINGS)
_DEMO = ('frames_offered', 'dropped_percent', 'tracked_of_delivered_percent', 'latency_ms_p50',
         'latency_ms_p95', 'latency_ms_p99', 'keyframes', 'loops', 'ate_rmse_m')


def main() -> int:
    arguments = parser(__doc__)
    arguments.add_argument('--data', type=Path, required=True)
    arguments.add_argument('--only', nargs='*', choices=PARTS, default=PARTS)
    args = arguments.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    for part in args.only:
        if part == 'messages':
            figures = said(_messages())
        elif not (args.data / RECORDINGS[0]).exists() or (
                part in RECORDINGS and not (args.data / part).exists()):
            print(f'# {part} skipped: {args.data} lacks its recording', file=sys.stderr)
            continue
        elif part == 'slow_model':
            figures = _slow_model(args.data / RECORDINGS[0], args.out)
        else:
            figures = _recording(args.data / part, args.out)
        add(args.out, figures)
    return 0


def _recording(source: Path, out: Path) -> Figures:
    """Over DDS and without it, on the same images."""
    name = f'ros_{source.name}'
    live = _run('demo', source, out / name, '--rate', str(RATE))
    alone = _run('evaluate', source, out / f'{name}_offline')
    figures = {f'{name}_{key}': live[key] for key in _DEMO}
    figures[f'{name}_offline_ate_rmse_m'] = alone['ate_rmse_m']
    if live['ate_rmse_m'] is not None and alone['ate_rmse_m']:
        figures[f'{name}_ate_ratio'] = live['ate_rmse_m'] / alone['ate_rmse_m']
    return said(figures)


def _slow_model(source: Path, out: Path) -> Figures:
    """Every third image of 30 Hz, at 10 Hz; an inference takes a second."""
    name = 'ros_slow_model'
    live = _run('demo', source, out / name, '--rate', str(SLOW_RATE), '--stride', '3',
                '--set', 'model.min_inference_s=1')
    posed = live['frames_offered'] - live['frames_dropped'] - live['frames_lost'] \
        - live['frames_skipped'] - live['frames_initialising']
    return said({f'{name}_poses_percent': 100.0 * posed / live['frames_offered'],
                 f'{name}_inferences': live['inferences'],
                 f'{name}_keyframes': live['keyframes'],
                 f'{name}_latency_ms_p50': live['latency_ms_p50'],
                 f'{name}_latency_ms_p95': live['latency_ms_p95'],
                 f'{name}_ate_rmse_m': live['ate_rmse_m']})


def _run(command: str, source: Path, out: Path, *options: str) -> dict[str, Any]:
    """metrics.json of a command line."""
    subprocess.run([sys.executable, '-m', f'aim_slam_ros.cli.{command}', str(source),
                    '--out', str(out), *options], check=True, stdout=subprocess.DEVNULL)
    return json.loads((out / 'metrics.json').read_text(encoding='utf-8'))


def _messages() -> Figures:
    """Median milliseconds of what happens to each image and each keyframe on its way."""
    rgb = np.random.default_rng(0).integers(0, 256, (480, 640, 3), np.uint8)
    image = images.image_msg(rgb, 1, 'camera')
    event = _event()
    sent = keyframes.keyframe_messages(event, 1, 'camera', 'map')
    return {
        'ros_image_encode_ms': _median_ms(lambda: images.image_msg(rgb, 1, 'camera')),
        'ros_image_serialise_ms': _median_ms(lambda: serialize_message(image)),
        'ros_image_deserialise_ms': _median_ms(_received(image)),
        'ros_image_decode_ms': _median_ms(lambda: encodings.rgb_from_image(image)),
        'ros_keyframe_encode_ms': _median_ms(
            lambda: keyframes.keyframe_messages(event, 1, 'camera', 'map')),
        'ros_keyframe_serialise_ms': _median_ms(lambda: serialize_message(sent.cloud)),
        'ros_keyframe_deserialise_ms': _median_ms(_received(sent.cloud)),
        'ros_keyframe_decode_ms': _median_ms(
            lambda: keyframes.keyframe_event(sent.table, sent.cloud)),
        'ros_keyframe_mb': len(serialize_message(sent.cloud)) / 2 ** 20}


def _received(message: Any) -> Callable[[], Any]:
    data = serialize_message(message)
    return lambda: deserialize_message(data, type(message))


def _event() -> KeyframeEvent:
    """A keyframe as the default settings make it of a 4:3 camera."""
    height, width = 392, 518
    rng = np.random.default_rng(0)
    points = torch.from_numpy(rng.uniform(0.5, 4.0, (height, width, 3)).astype(np.float32))
    descriptor = torch.ones(256) / 16.0
    return KeyframeEvent(0, 0, 1, rng.integers(0, 256, (height, width, 3), np.uint8),
                         torch.tensor([[450.0, 0, 259], [0, 450, 196], [0, 0, 1]]).double(),
                         points, torch.full((height, width), 3.0), torch.eye(4).double(),
                         descriptor)


def _median_ms(work: Callable[[], Any], times: int = 30) -> float:
    seconds = []
    for _ in range(times):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    return 1e3 * statistics.median(seconds)


if __name__ == '__main__':
    sys.exit(main())
