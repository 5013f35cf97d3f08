"""The odom frame: where the camera has gone since the start, without the map's jumps."""

from __future__ import annotations

from torch import Tensor

from ..geometry import sim3


class OdometryFrame:
    """Keeps the pose continuous while the world is corrected or begun anew.

    Its axes and its unit are those of the first world. T_odom_world: [4,4] float64 Sim(3).
    """

    def __init__(self) -> None:
        self.T_odom_world = sim3.identity()
        self._T_odom_cam: Tensor | None = None

    def place(self, T_world_cam: Tensor) -> Tensor:
        """T_odom_cam [4,4], rigid."""
        self._T_odom_cam = sim3.rigid_part(self.T_odom_world @ T_world_cam)
        return self._T_odom_cam

    def correct(self, T_new_old: Tensor) -> None:
        """The world moved where the camera is; the camera did not."""
        self.T_odom_world = self.T_odom_world @ sim3.inverse(T_new_old)

    def begin_world(self, T_world_cam: Tensor) -> None:
        """Another world begins at this pose: the camera goes on from where it was last.

        How far it went in between and how long the new unit is nobody knows.
        """
        if self._T_odom_cam is not None:
            scale = float(sim3.scale_of(self.T_odom_world))
            self.T_odom_world = sim3.with_scale(self._T_odom_cam, scale) \
                @ sim3.with_scale(sim3.inverse(T_world_cam), 1.0)
