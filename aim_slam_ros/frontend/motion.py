"""Where the camera will be if it keeps moving as it did."""

from __future__ import annotations

from torch import Tensor

from ..geometry import sim3

_LONGEST_GAP = 4.0   # over a longer gap than so many steps a velocity says nothing


class ConstantVelocity:
    """Predicts a rigid pose from the last two."""

    def __init__(self) -> None:
        self._last: tuple[int, Tensor] | None = None
        self._before: tuple[int, Tensor] | None = None

    @property
    def T_world_cam(self) -> Tensor:
        """The last pose, [4,4]; raises LookupError before the first."""
        if self._last is None:
            raise LookupError('no image has been tracked yet')
        return self._last[1]

    def update(self, stamp_ns: int, T_world_cam: Tensor) -> None:
        """A second pose of the same image replaces the first; of an older one it says nothing."""
        if self._last is not None and stamp_ns < self._last[0]:
            return
        if self._last is None or stamp_ns > self._last[0]:
            self._before = self._last
        self._last = (stamp_ns, T_world_cam)

    def stop(self) -> None:
        """Forget the velocity, keep the pose."""
        self._before = None

    def move_world(self, T_new_old: Tensor) -> None:
        """The world was corrected: T_new_old is a Sim(3)."""
        self._last, self._before = (
            old if old is None else (old[0], sim3.rigid_part(T_new_old @ old[1]))
            for old in (self._last, self._before))

    def predict(self, stamp_ns: int) -> Tensor:
        """T_world_cam [4,4] at this time."""
        T = self.T_world_cam
        if self._last is None or self._before is None:
            return T
        steps = (stamp_ns - self._last[0]) / max(self._last[0] - self._before[0], 1)
        if not 0.0 < steps <= _LONGEST_GAP:
            return T
        step = sim3.log(sim3.inverse(self._before[1]) @ T)
        return T @ sim3.exp(min(steps, 2.0) * step)
