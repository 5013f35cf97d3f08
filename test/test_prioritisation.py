"""Which keyframes join first: by information, or the newest."""

from __future__ import annotations

from dataclasses import replace

import box_room
import torch

from aim_slam_ros.config import SigmaConfig
from aim_slam_ros.frontend.keyframe_map import KeyframeMap
from aim_slam_ros.frontend.prioritisation import make_prioritiser
from aim_slam_ros.frontend.sigma import rerank
from aim_slam_ros.types import FrameEncoding

BY_INFORMATION = SigmaConfig()
BY_RECENCY = replace(BY_INFORMATION, prioritiser='recency')


def _map(*turns: float) -> KeyframeMap:
    """Keyframes a step apart that look away from the first by these angles [rad]."""
    keyframes = KeyframeMap(BY_INFORMATION)
    for k, turn in enumerate(turns):
        T = box_room.pose((0.1 * k, 0.0, -1.2), (0.0, turn, 0.0))
        made = box_room.keyframe(k, T, 1.0 + 0.2 * k)
        encoding = FrameEncoding(made.frame, torch.ones(1), None)
        keyframes.add(encoding, made.K, made.points_cam, made.confidence, made.T_world_kf)
    return keyframes


def test_information_asks_those_that_see_the_same() -> None:
    keyframes = _map(0.0, 0.1, 0.05, 3.1, 3.1)
    prioritiser = make_prioritiser(BY_INFORMATION)
    ranked = prioritiser.ranked(keyframes[2], keyframes)
    gains = rerank(keyframes[2], keyframes.overlapping(2), BY_INFORMATION)
    assert ranked == tuple(r.keyframe_id for r in gains) and set(ranked[:2]) == {0, 1}
    settled = replace(keyframes[2], confidence=3 * keyframes[2].confidence, observations=3)
    assert set(prioritiser.reranked(settled, [keyframes[0], keyframes[3]])) == {0, 3}
    assert prioritiser.reranked(settled, [keyframes[3], keyframes[0]])[0] == 0


def test_recency_takes_the_newest_whatever_they_see() -> None:
    keyframes = _map(0.0, 0.1, 0.05, 3.1, 3.1)
    prioritiser = make_prioritiser(BY_RECENCY)
    assert prioritiser.ranked(keyframes[2], keyframes) == (4, 3, 1, 0)
    assert prioritiser.reranked(keyframes[2], [keyframes[0], keyframes[3]]) == (3, 0)
    few = make_prioritiser(replace(BY_RECENCY, candidates=2))
    assert few.ranked(keyframes[4], keyframes) == (3, 2)


def test_neither_leaves_the_map_piece_nor_fails_alone() -> None:
    keyframes = _map(0.0, 0.1)
    keyframes.begin_piece()
    made = box_room.keyframe(2, box_room.trajectory(1)[0])
    encoding = FrameEncoding(made.frame, torch.ones(1), None)
    only = keyframes.add(encoding, made.K, made.points_cam, made.confidence, made.T_world_kf)
    for config in (BY_INFORMATION, BY_RECENCY):
        assert make_prioritiser(config).ranked(only, keyframes) == ()
