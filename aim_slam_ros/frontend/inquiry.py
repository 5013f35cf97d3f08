"""What the model is asked about an image, and how the answer is found.

An inquiry may be worked on in another thread while images go on being followed. It only reads the
map, so the map must not be written until its findings have been concluded.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from ..config import Config
from ..types import Frame, FrameEncoding
from .following import Followed, Follower
from .initialisation import Inferred, Initialisation
from .keyframe_map import KeyframeMap
from .landmarks import followed_corners
from .relocalisation import Relocalisation
from .stages import Stopwatch
from .window import WindowEstimate, WindowTracker


@dataclass(frozen=True)
class BeginningInquiry:
    """Whether a map can begin with this window, the current frame first."""

    window: tuple[Frame, ...]
    initialisation: Initialisation
    clock: Stopwatch

    @property
    def frame(self) -> Frame:
        return self.window[0]


@dataclass(frozen=True)
class TrackingInquiry:
    """Where a frame is and what it sees. lost: the frame before had no pose either.

    reference_id: the keyframe that counted when it was followed. K: [3,3] float64 of the frame.
    """

    frame: Frame
    followed: Followed
    reference_id: int
    K: Tensor
    lost: bool
    clock: Stopwatch


Inquiry = BeginningInquiry | TrackingInquiry


@dataclass(frozen=True)
class Findings:
    """The answer about a frame. found: where a lost frame was found again, reference first."""

    inferences: int
    inferred: Inferred | None = None
    encoding: FrameEncoding | None = None
    found: Followed | None = None
    estimate: WindowEstimate | None = None


class Inquirer:
    """Works on one inquiry at a time."""

    def __init__(self, config: Config, keyframes: KeyframeMap, window: WindowTracker) -> None:
        self._map = keyframes
        self._window = window
        # A follower of its own: the other one may be at work on the next image.
        follower = Follower(config.following, followed_corners(config.following))
        self._relocalisation = Relocalisation(config, keyframes, follower, window)

    def run(self, inquiry: Inquiry) -> Findings:
        """Ask the model, as often as it takes."""
        if isinstance(inquiry, BeginningInquiry):
            inferred = inquiry.initialisation.infer(inquiry.window, inquiry.clock)
            return Findings(1, inferred=inferred)
        before = self._window.inferences
        encoding = self._window.encode(inquiry.frame, inquiry.clock)
        found, estimate = None, None
        if inquiry.lost and not inquiry.followed.ok:
            found = self._relocalisation.find(encoding, inquiry.K, inquiry.clock)
        if found is not None or inquiry.followed.ok or not inquiry.lost:
            estimate = self._track(inquiry, encoding, found)
        return Findings(self._window.inferences - before, None, encoding, found, estimate)

    def _track(self, inquiry: TrackingInquiry, encoding: FrameEncoding,
               found: Followed | None) -> WindowEstimate:
        followed = inquiry.followed if found is None else found
        reference_id = inquiry.reference_id if found is None else found.reference_id
        return self._window.track(encoding, followed.T_world_cam if followed.ok else None,
                                  reference_id, self._map, inquiry.clock)
