"""What every tracker takes and returns."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Callable, Protocol

from torch import Tensor

from ..types import Frame, Keyframe, WindowPrediction


@dataclass(frozen=True)
class TrackingWindow:
    """The current frame, an inference over it and its keyframes, and the map's view of them.

    keyframes: in the order of the prediction's views 1..N-1 (view 0 is the current frame).
    T_world_frame_guess: rigid [4,4] pose from image following, where there is one.
    """

    frame: Frame
    prediction: WindowPrediction
    keyframes: tuple[Keyframe, ...]
    T_world_frame_guess: Tensor | None = None


@dataclass(frozen=True)
class TrackingResult:
    """Where the current frame is.

    T_world_frame: [4,4] float64 Sim(3); it maps the current frame's predicted points, in the
    prediction's unit, to the world. kappa: reduced chi-square (paper, stability criterion): of the
    optimisation, or of what it started from where the tracker says so.
    matched_fraction: share of the current frame that a keyframe of the window sees too.
    moved: new T_world_kf of the keyframes that moved. measured: gives T_kf_frame [4,4] Sim(3) as
    each keyframe alone measures it, for the pose graph. optimised: false where the pose is but a
    guess. reason: why ``ok`` is false, for a person.
    """

    ok: bool
    T_world_frame: Tensor
    kappa: float
    matched_fraction: float
    moved: dict[int, Tensor] = field(default_factory=dict)
    measured: Callable[[], dict[int, Tensor]] = dict
    optimised: bool = True
    reason: str = ''


class Tracker(Protocol):
    """Places the current frame of a window in the world."""

    def track(self, window: TrackingWindow) -> TrackingResult:
        """Expected failure is a result with ``ok`` false."""
