"""What the frontend keeps is bounded by the place it is in, not by how long it is there."""

from __future__ import annotations

import gc

import clip as clips
from clip import Clip
from true_model import TrueModel

from aim_slam_ros.frontend.pipeline import FrontendPipeline
from aim_slam_ros.nodes.memory import memory_mb
from aim_slam_ros.types import Keyframe, TrackingStatus

ROUNDS = 5              # there and back again
STEP_NS = 33_000_000
SETTLED = 2             # rounds after which the place is known


def _walk(pipeline: FrontendPipeline, clip: Clip, number: int) -> None:
    """There and back; every image is tracked."""
    there = list(range(0, len(clip), 2))
    path = there + there[-2:0:-1]
    for step, i in enumerate(path):
        stamp_ns = (1 + number * len(path) + step) * STEP_NS
        result = pipeline.process(stamp_ns, clip.images[i], clip.K)
        assert result.status is TrackingStatus.TRACKED, (number, i, result.reason)


def _held_mb(keyframe: Keyframe) -> float:
    """Arrays and tensors with all of their storage, which a view shares with what it is of."""
    tensors = (keyframe.points_cam, keyframe.confidence, keyframe.K, keyframe.T_world_kf)
    held = sum(tensor.untyped_storage().nbytes() for tensor in tensors)
    return (held + keyframe.frame.image.nbytes + keyframe.frame.grey.nbytes) / 2**20


def test_memory_follows_the_place_and_not_the_time(clip: Clip) -> None:
    pipeline = FrontendPipeline(clips.config(), TrueModel(clip))
    keyframes, memory = [], []
    for number in range(ROUNDS):
        _walk(pipeline, clip, number)
        gc.collect()
        keyframes.append(len(pipeline.keyframes))
        memory.append(memory_mb())
    assert keyframes[-1] == keyframes[SETTLED - 1], keyframes
    # less than two keyframes' worth over hundreds of images: the allocator's own unrest
    assert memory[-1] - memory[SETTLED - 1] < 4.0, memory
    frame = pipeline.keyframes[0].frame
    # three coordinates and a confidence in float32, three colours and a grey value
    expected = frame.height * frame.width * (4 * 4 + 3 + 1) / 2**20
    for keyframe in pipeline.keyframes:
        assert _held_mb(keyframe) < 1.01 * expected, keyframe.keyframe_id
