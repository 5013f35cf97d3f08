"""Where the odom frame lies in the corrected map."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ..geometry import sim3

# A baseline shorter than this share of the coordinates is lost in their float32 rounding.
_MIN_BASELINE = 1e-4


@dataclass(frozen=True)
class _Anchor:
    """The first frame of a run of frames with the same reference, to measure the units on."""

    reference_id: int
    t_kf_cam: Tensor
    t_odom_cam: Tensor


class MapFromOdom:
    """T_map_odom as a Sim(3): odom keeps the unit it was born with, the map's may change.

    It holds until the next frame with a known keyframe, and places those whose keyframe is
    still on its way.
    """

    def __init__(self) -> None:
        self._T_map_odom = sim3.identity()
        self._anchor: _Anchor | None = None
        self._baseline = 0.0
        self._odom_per_kf = 1.0

    def place(self, T_odom_cam: Tensor) -> Tensor:
        """T_map_cam [4,4] float64, rigid; before anything was learned the two frames are one."""
        return sim3.rigid_part(self._T_map_odom @ T_odom_cam)

    def learn(self, reference_id: int, T_world_kf: Tensor, T_kf_cam: Tensor,
              T_odom_cam: Tensor) -> Tensor:
        """A frame with a known keyframe; its T_map_cam [4,4] float64, rigid.

        T_world_kf: Sim(3) in the map. T_kf_cam, T_odom_cam: rigid, in the units of the keyframe
        and of odom.
        """
        T_map_cam = sim3.rigid_part(T_world_kf @ T_kf_cam)
        map_per_odom = self._map_per_odom(reference_id, T_world_kf, T_kf_cam, T_odom_cam)
        rotation = sim3.rotation_of(T_map_cam) @ sim3.rotation_of(T_odom_cam).mT
        offset = map_per_odom * rotation @ sim3.translation_of(T_odom_cam)
        self._T_map_odom = sim3.from_parts(map_per_odom, rotation,
                                           sim3.translation_of(T_map_cam) - offset)
        return T_map_cam

    def _map_per_odom(self, reference_id: int, T_world_kf: Tensor, T_kf_cam: Tensor,
                      T_odom_cam: Tensor) -> float:
        """The ratio of units, from how far the camera moved in both since the anchor."""
        t_kf, t_odom = sim3.translation_of(T_kf_cam), sim3.translation_of(T_odom_cam)
        map_per_kf = float(sim3.scale_of(T_world_kf))
        if self._anchor is None or self._anchor.reference_id != reference_id:
            self._anchor, self._baseline = _Anchor(reference_id, t_kf, t_odom), 0.0
            return float(sim3.scale_of(self._T_map_odom))
        moved_kf = float((t_kf - self._anchor.t_kf_cam).norm())
        moved_odom = float((t_odom - self._anchor.t_odom_cam).norm())
        rounding = _MIN_BASELINE * float(torch.stack([t_kf, t_odom]).norm())
        if min(moved_kf, moved_odom) > max(rounding, self._baseline):
            self._baseline = min(moved_kf, moved_odom)
            self._odom_per_kf = moved_odom / moved_kf
        if not self._baseline:
            return float(sim3.scale_of(self._T_map_odom))
        return map_per_kf / self._odom_per_kf
