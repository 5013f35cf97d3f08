"""What a run over a sequence leaves behind, and the trajectories that follow from it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from dataclasses import dataclass
from functools import cached_property
from typing import Iterable, Mapping

import numpy as np
import torch
from torch import Tensor

from aim_slam_ros.evaluation.delivery import Delivery
from aim_slam_ros.geometry import sim3
from aim_slam_ros.types import Cloud, FrameResult, StampedPoses, TrackingStatus


@dataclass(frozen=True)
class UnreadableImage:
    """An image file that was skipped, and why."""

    path: str
    reason: str


@dataclass(frozen=True)
class PlacedKeyframe:
    """A keyframe where it ended up. T_world_kf: [4,4] float64, with its scale."""

    keyframe_id: int
    piece_id: int
    stamp_ns: int
    T_world_kf: Tensor


@dataclass(frozen=True)
class LoopPair:
    """Two keyframes that a loop closure joined."""

    newer: int
    older: int


@dataclass(frozen=True)
class Run(ABC):
    """Everything a run produced; of an interrupted run, everything until then.

    results: one for every image that was answered, in time order. offered: images asked for,
    readable or not. wall_s: from the first image read to the last result, without building the
    model. stage_s: seconds in each stage over the whole run. map_cloud: fused, in the world
    frame. rotation_only_inferences: None where nobody counted them.
    """

    results: tuple[FrameResult, ...]
    unreadable: tuple[UnreadableImage, ...]
    offered: int
    wall_s: float
    stage_s: Mapping[str, float]
    keyframes: tuple[PlacedKeyframe, ...]
    map_cloud: Cloud
    rotation_only_inferences: int | None
    interrupted: bool

    @property
    @abstractmethod
    def trajectory(self) -> StampedPoses:
        """The tracked frames where they ended up."""

    @property
    @abstractmethod
    def causal_trajectory(self) -> StampedPoses:
        """The tracked frames with the pose that was reported at the time."""

    @property
    @abstractmethod
    def late(self) -> int:
        """Images that waited for the map to begin and were placed in it afterwards."""

    @property
    @abstractmethod
    def loop_count(self) -> int:
        """Loops that were closed."""

    @property
    @abstractmethod
    def delivery(self) -> Delivery | None:
        """How images and poses travelled; None for a run within one process."""

    @cached_property
    def keyframe_trajectory(self) -> StampedPoses:
        """The keyframes of the largest connected map, without their scales."""
        if not self.pieces:
            return stamped(())
        (largest, _), = self.pieces.most_common(1)
        return stamped((k.stamp_ns, sim3.rigid_part(k.T_world_kf)) for k in sorted(
            self.keyframes, key=lambda k: k.stamp_ns) if k.piece_id == largest)

    @cached_property
    def pieces(self) -> Counter[int]:
        """Tracked frames in each connected map; where their keyframes ended up decides."""
        return Counter(self._piece(result) for result in self._with_pose)

    @cached_property
    def tracked(self) -> tuple[FrameResult, ...]:
        """The frames that count as tracked: with a pose in the largest connected map."""
        if not self.pieces:
            return ()
        (largest, _), = self.pieces.most_common(1)
        return tuple(r for r in self._with_pose if self._piece(r) == largest)

    def count(self, status: TrackingStatus) -> int:
        return sum(result.status is status for result in self.results)

    @cached_property
    def _keyframe(self) -> dict[int, PlacedKeyframe]:
        return {keyframe.keyframe_id: keyframe for keyframe in self.keyframes}

    @cached_property
    def _with_pose(self) -> list[FrameResult]:
        return [r for r in self.results
                if r.status is TrackingStatus.TRACKED and r.reference_id in self._keyframe]

    def _piece(self, result: FrameResult) -> int:
        assert result.reference_id is not None
        return self._keyframe[result.reference_id].piece_id


@dataclass(frozen=True)
class RunResult(Run):
    """A run within this process, where every image was processed in turn.

    results: one for every readable image. stage_s: reading and loop closure included.
    """

    loops: tuple[LoopPair, ...]

    @cached_property
    def trajectory(self) -> StampedPoses:
        """Every tracked frame, from its keyframe's final pose."""
        return stamped((r.stamp_ns, self._final_pose(r)) for r in self.tracked)

    @cached_property
    def causal_trajectory(self) -> StampedPoses:
        """The same frames, with the pose that was reported at the time."""
        return stamped((r.stamp_ns, r.T_world_cam) for r in self.tracked
                       if r.T_world_cam is not None)

    @property
    def late(self) -> int:
        return sum(len(result.late) for result in self.results)

    @property
    def loop_count(self) -> int:
        return len(self.loops)

    @property
    def delivery(self) -> None:
        """Nothing travelled."""

    def _final_pose(self, result: FrameResult) -> Tensor:
        """[4,4] float64, rigid: T_world_kf T_kf_cam; the keyframe's scale moves it, no more."""
        assert result.reference_id is not None and result.T_kf_cam is not None
        return sim3.rigid_part(self._keyframe[result.reference_id].T_world_kf @ result.T_kf_cam)


def stamped(poses: Iterable[tuple[int, Tensor]]) -> StampedPoses:
    """Poses in the order given; T_world_cam [4,4] float64, rigid, for each stamp [ns]."""
    pairs = list(poses)
    if not pairs:
        return StampedPoses(np.zeros(0, np.int64), np.zeros((0, 4, 4)))
    return StampedPoses(np.array([stamp for stamp, _ in pairs], np.int64),
                        torch.stack([T for _, T in pairs]).numpy())
