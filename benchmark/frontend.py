"""What the frontend costs beside the model, stage by stage, one figure a line.

    .venv/bin/python benchmark/frontend.py --out FOLDER [--images 120]

On the rendered room, at 518x392, with a model that knows the scene's geometry and whose time does
not count; windows of 3 and of 5 views. Every image is asked about, as in the paper. The voxel
index is measured on a building of box rooms. Adds to benchmark.json: ``name: number``, the unit in
the name. reference_matmul_ms is a float32 product of 1024x1024 matrices: what this machine had to
give at the time.
"""

from __future__ import annotations

import gc
import math
import time
from dataclasses import dataclass
from typing import Callable, Sequence

import aim_slam_ros  # noqa: F401: before torch, to which it says how its threads wait
import cv2
import numpy as np
import torch
from figures import Figures, add, parser, said
from torch import Tensor

from aim_slam_ros.config import Config, SigmaConfig
from aim_slam_ros.datasets import load_sequence
from aim_slam_ros.datasets.base import Sequence as ImageSequence
from aim_slam_ros.frontend.alignment import observed, pose_mean
from aim_slam_ros.frontend.following import Follower
from aim_slam_ros.frontend.image_tracking import ImageTracker
from aim_slam_ros.frontend.joint_tracking import JointTracker
from aim_slam_ros.frontend.keyframe_map import KeyframeMap
from aim_slam_ros.frontend.landmarks import followed_corners, matched_grid
from aim_slam_ros.frontend.matching import predict_matches
from aim_slam_ros.frontend.pipeline import FrontendPipeline
from aim_slam_ros.frontend.sigma import rerank
from aim_slam_ros.frontend.tracking import TrackingWindow
from aim_slam_ros.frontend.voxel_index import VoxelIndex
from aim_slam_ros.geometry import camera, sim3
from aim_slam_ros.nodes.memory import memory_mb
from aim_slam_ros.registration.rigid import solve_rigid
from aim_slam_ros.types import (Frame, FrameEncoding, FrameResult, Keyframe, TrackingStatus,
                                WindowPrediction)

WIDTH, HEIGHT = 518, 392
VIEWS = (3, 5)
MODEL_STAGES = ('encode', 'infer')
MAP_SIZES = (500, 2000)
ROOM_KEYFRAMES = 50     # of one room of the building
FEWEST = 60             # images, for windows to become full
STEPS = 12              # keyframes of the map that single stages are measured on
REPEAT = 15
MEMORY_KEYFRAMES = 60


class KnownGeometry:
    """A model that looks up a rendered sequence by stamp: smooth errors, a unit per inference."""

    min_views = 1

    def __init__(self, sequence: ImageSequence, count: int) -> None:
        assert sequence.groundtruth is not None and sequence.K is not None
        K = torch.as_tensor(sequence.K).double()
        self.K = camera.scaled(K, WIDTH / (2 * float(K[0, 2]) + 1),
                               HEIGHT / (2 * float(K[1, 2]) + 1))
        self._rng = np.random.default_rng(0)
        self.unit = 1.0   # metres in the unit of the last inference
        self.T_world_cam = {int(sequence.stamps_ns[i]): torch.from_numpy(
            sequence.groundtruth.T_world_cam[i]) for i in range(count)}
        self._depth = {int(sequence.stamps_ns[i]): self._depth_of(sequence, i)
                       for i in range(count)}

    def encode(self, frame: Frame) -> FrameEncoding:
        return FrameEncoding(frame, torch.ones(1), None)

    def infer(self, encodings: Sequence[FrameEncoding]) -> WindowPrediction:
        stamps = [encoding.frame.stamp_ns for encoding in encodings]
        unit = self.unit = math.exp(0.3 * self._rng.standard_normal())
        T = torch.stack([self.T_world_cam[stamp] for stamp in stamps])
        T_first = sim3.inverse(T[0]) @ T
        T_first[:, :3, 3] /= unit
        return WindowPrediction(
            torch.stack([self._depth[stamp] for stamp in stamps]) / unit,
            torch.stack([1.0 + (0.6 * self._smooth()).exp() * 4.0 for _ in stamps]),
            self.K.expand(len(stamps), 3, 3), T_first)

    def _depth_of(self, sequence: ImageSequence, index: int) -> Tensor:
        depth = sequence.depth(index)
        assert depth is not None
        resized = cv2.resize(depth, (WIDTH, HEIGHT), interpolation=cv2.INTER_NEAREST)
        return torch.from_numpy(resized) * (0.02 * self._smooth()).exp()

    def _smooth(self) -> Tensor:
        coarse = self._rng.standard_normal((6, 8)).astype(np.float32)
        return torch.from_numpy(cv2.resize(coarse, (WIDTH, HEIGHT),
                                           interpolation=cv2.INTER_CUBIC))


@dataclass(frozen=True)
class Inputs:
    """Images of the scene and the model that knows it."""

    stamps_ns: list[int]
    images: list[np.ndarray]
    model: KnownGeometry


def main() -> int:
    arguments = parser(__doc__)
    arguments.add_argument('--images', type=int, default=120)
    args = arguments.parse_args()
    sequence = load_sequence('rendered:room')
    count = min(args.images, len(sequence))
    if count < FEWEST:
        arguments.error(f'--images {args.images}: at least {FEWEST}')
    inputs = Inputs([int(s) for s in sequence.stamps_ns[:count]],
                    [sequence.image(i) for i in range(count)], KnownGeometry(sequence, count))
    # Memory first: later there is freed memory that would be used again.
    figures = said(_memory(inputs)) | said(_matmul())
    for views in VIEWS:
        figures |= said(_rate(inputs, views))
    figures |= said(_stages(inputs)) | said(_voxels())
    args.out.mkdir(parents=True, exist_ok=True)
    add(args.out, figures)
    return 0


def _matmul() -> Figures:
    a = torch.rand(1024, 1024)
    return {'reference_matmul_ms': _median_ms(lambda: a @ a)}


def _median_ms(call: Callable[[], object], repeat: int = REPEAT) -> float:
    """Of the calls after the first, which warms up."""
    call()
    times = []
    for _ in range(repeat):
        start = time.perf_counter()
        call()
        times.append(1e3 * (time.perf_counter() - start))
    return float(np.median(times))


def _config(views: int, infer: str = 'every_image') -> Config:
    return Config().with_values({'model.infer': infer, 'sigma.min_window': str(views),
                                 'sigma.max_window': str(views)})


def _rate(inputs: Inputs, views: int) -> Figures:
    """The whole frontend over the images, each asked about with so many views."""
    pipeline = FrontendPipeline(_config(views), inputs.model)
    results, seconds = [], []
    for stamp_ns, image in zip(inputs.stamps_ns, inputs.images):
        start = time.perf_counter()
        result = pipeline.process(stamp_ns, image)
        seconds.append(time.perf_counter() - start - _model_s(result))
        results.append(result)
    # Before there are as many keyframes as the window wants, an image costs less.
    full = [i for i, r in enumerate(results) if len(r.window) == views - 1]
    tracked = sum(r.status is TrackingStatus.TRACKED for r in results)
    stages = sorted({name for r in results for name in r.stage_s} - set(MODEL_STAGES))
    return {f'frontend_without_model_hz_window{views}':
            len(full) / sum(seconds[i] for i in full) if full else None,
            f'frontend_full_windows_window{views}': len(full),
            f'frontend_tracked_percent_window{views}': 100.0 * tracked / len(results),
            f'frontend_keyframes_window{views}': len(pipeline.keyframes)} | {
        f'frontend_{name}_ms_window{views}': 1e3 * float(np.mean(
            [results[i].stage_s.get(name, 0.0) for i in full])) for name in stages}


def _model_s(result: FrameResult) -> float:
    return sum(result.stage_s.get(name, 0.0) for name in MODEL_STAGES)


def _keyframes(inputs: Inputs, count: int) -> KeyframeMap:
    """The first images as keyframes, each in a unit of its own."""
    config = Config()
    keyframes = KeyframeMap(config.sigma)
    step = max(1, (len(inputs.images) - 1) // count)
    for i in range(0, step * count, step):
        encoding = inputs.model.encode(_frame(inputs, i))
        prediction = inputs.model.infer([encoding])
        unit = inputs.model.unit
        keyframes.add(encoding, inputs.model.K,
                      camera.unproject(prediction.depth[0], inputs.model.K),
                      prediction.confidence[0],
                      sim3.with_scale(inputs.model.T_world_cam[inputs.stamps_ns[i]], unit))
    return keyframes


def _frame(inputs: Inputs, index: int) -> Frame:
    image = cv2.resize(inputs.images[index], (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    return Frame(inputs.stamps_ns[index], image, inputs.model.K)


def _stages(inputs: Inputs) -> Figures:
    """Single stages on the last image of the map's part of the scene."""
    keyframes, config = _keyframes(inputs, STEPS), Config()
    frame = _frame(inputs, (len(inputs.images) - 1) // STEPS * (STEPS - 1) + 2)
    T_world_cam = inputs.model.T_world_cam[frame.stamp_ns]
    last, *others = keyframes.piece[::-1]
    follower = Follower(config.following, followed_corners(config.following))
    figures: Figures = {
        'following_ms': _median_ms(lambda: follower.follow(
            frame.grey, inputs.model.K, T_world_cam, [last, *others[:2]])),
        'information_gain_ms_10_candidates': _median_ms(
            lambda: rerank(last, others[:10], config.sigma))}
    for views in VIEWS:
        window = (last, *others[:views - 2])
        figures |= _tracking(inputs, frame, window, views)
    return figures


def _tracking(inputs: Inputs, frame: Frame, keyframes: tuple[Keyframe, ...],
              views: int) -> Figures:
    config, K = Config(), inputs.model.K
    T_world_cam = inputs.model.T_world_cam[frame.stamp_ns]
    prediction = inputs.model.infer([inputs.model.encode(frame), *(k.encoding for k in keyframes)])
    window = TrackingWindow(frame, prediction, keyframes, T_world_cam)
    landmarks, sigma_depth = matched_grid(config.tracking.stride), config.following.sigma_depth
    found = predict_matches(keyframes, landmarks, frame.grey, K, T_world_cam, sigma_depth)
    by_images = ImageTracker(config.tracking, config.following, config.keyframes.min_confident)
    by_rays = JointTracker(config.joint_tracking)
    figures: Figures = {
        'pose_mean': _median_ms(lambda: pose_mean(window, 0.05)),
        'choosing': _median_ms(lambda: matched_grid(config.tracking.stride).of(keyframes[0])),
        'matching': _median_ms(lambda: predict_matches(
            keyframes, landmarks, frame.grey, K, T_world_cam, sigma_depth)),
        'solve': _median_ms(lambda: solve_rigid(
            found.points_world, found.uv, K, sim3.inverse(T_world_cam), found.spread_world,
            config.tracking.sigma_px)),
        'tracker_image': _median_ms(lambda: by_images.track(window)),
        'tracker_paper': _median_ms(lambda: by_rays.track(window)),
        'fusion': _median_ms(lambda: [observed(keyframe, prediction, view, config.keyframes)
                                      for view, keyframe in enumerate(keyframes, 1)])}
    return {f'{name}_ms_window{views}': value for name, value in figures.items()}


def _voxels() -> Figures:
    """Query and insertion in a map of that many keyframes."""
    figures: Figures = {}
    clouds = _building(max(MAP_SIZES))
    for size in MAP_SIZES:
        index = VoxelIndex(SigmaConfig().voxel_fraction * 2.5)
        times = []
        for keyframe_id in range(size):
            start = time.perf_counter()
            index.insert(keyframe_id, clouds[keyframe_id])
            times.append(1e3 * (time.perf_counter() - start))
        asked = range(0, size, size // 100)
        seconds = [_median_ms(lambda i=i: index.overlap_of(i), 3) for i in asked]  # type: ignore
        figures |= {f'voxel_query_ms_{size}_keyframes': float(np.mean(seconds)),
                    f'voxel_query_worst_ms_{size}_keyframes': max(seconds),
                    f'voxel_insert_ms_{size}_keyframes': float(np.median(times[-50:])),
                    f'voxel_observers_{size}_keyframes': float(np.mean(
                        [len(index.overlap_of(i).keyframe_ids) for i in asked]))}
    return figures


def _building(count: int) -> list[Tensor]:
    """What keyframes [N,3] see of rooms of 5 x 5 x 2.8 m, so many keyframes to a room."""
    rng = np.random.default_rng(0)
    half = torch.tensor([2.5, 1.4, 2.5])
    rays = camera.unproject(torch.ones(HEIGHT // 4, WIDTH // 4),
                            camera.intrinsics_from_fov(WIDTH // 4, HEIGHT // 4, 60.0))
    clouds = []
    for i in range(count):
        angle = float(rng.uniform(0, 2 * math.pi))
        turn = torch.tensor([[math.cos(angle), 0, math.sin(angle)], [0, 1, 0],
                             [-math.sin(angle), 0, math.cos(angle)]])
        origin = torch.from_numpy(rng.uniform(-1.5, 1.5, 3) * (1, 0.3, 1)).float()
        direction = rays.reshape(-1, 3) @ turn.T
        depth = ((torch.where(direction < 0, -half, half) - origin) / direction).amin(-1)
        room = torch.tensor([5.2 * (i // ROOM_KEYFRAMES), 0.0, 0.0])
        clouds.append(origin + direction * depth[:, None] + room)
    return clouds


def _memory(inputs: Inputs) -> Figures:
    """What the process grows by with each keyframe of the map, the model's own features aside."""
    frame = _frame(inputs, 0)
    prediction = inputs.model.infer([inputs.model.encode(frame)])
    keyframes = KeyframeMap(SigmaConfig())
    gc.collect()
    before = memory_mb()
    for i in range(MEMORY_KEYFRAMES):
        own = Frame(i, frame.image.copy(), inputs.model.K)
        own.grey   # followed keyframes have it
        T = sim3.identity()
        T[0, 3] = 0.2 * i
        keyframes.add(inputs.model.encode(own), inputs.model.K,
                      camera.unproject(prediction.depth[0], inputs.model.K),
                      prediction.confidence[0], T)
    return {'keyframe_memory_mb': (memory_mb() - before) / MEMORY_KEYFRAMES}


if __name__ == '__main__':
    raise SystemExit(main())
