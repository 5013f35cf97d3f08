"""A run as another process heard it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from aim_slam_ros.evaluation.delivery import Delivery
from aim_slam_ros.evaluation.run_result import Run
from aim_slam_ros.types import StampedPoses


@dataclass(frozen=True)
class ReceivedRun(Run):
    """A run over topics: its poses are those that were published, none is computed again.

    path: corrected, as last published. reported: the pose of each image as it came; an image that
    was placed after newer ones has none. Both may hold images that do not count as tracked.
    placed_late: of ``results``, how many had no pose at first. loops_closed: as loop closure
    counts them.
    """

    path: StampedPoses
    reported: StampedPoses
    placed_late: int
    loops_closed: int
    travelled: Delivery

    @cached_property
    def trajectory(self) -> StampedPoses:
        """The tracked frames of the path."""
        return self._tracked_part(self.path)

    @cached_property
    def causal_trajectory(self) -> StampedPoses:
        """The tracked frames with the pose that was reported at the time, where one was."""
        return self._tracked_part(self.reported)

    @property
    def late(self) -> int:
        return self.placed_late

    @property
    def loop_count(self) -> int:
        return self.loops_closed

    @property
    def delivery(self) -> Delivery:
        return self.travelled

    def _tracked_part(self, poses: StampedPoses) -> StampedPoses:
        counted = np.isin(poses.stamps_ns, [result.stamp_ns for result in self.tracked])
        return StampedPoses(poses.stamps_ns[counted], poses.T_world_cam[counted])
