"""The beginning of a map: one inference over the first views that show parallax."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Sequence

import cv2
import numpy as np
import torch

from ..config import CameraConfig, InitialisationConfig
from ..geometry import camera, rotation
from ..registration.flow import refine
from ..types import Frame, FrameEncoding, WindowPrediction
from .stages import Stopwatch
from .window import WindowTracker

_FEWEST_TRACKS = 0.35   # a smaller share of the first image's corners left: begin again from here
_PATIENCE = 1.3         # a window that showed no depth is tried again with this much more parallax
_MOST = 4.0             # and never with more than so many times what was awaited first


@dataclass(frozen=True)
class Inferred:
    """An inference over a first window: the current frame first, the oldest second."""

    encodings: tuple[FrameEncoding, ...]
    prediction: WindowPrediction


@dataclass(frozen=True)
class Beginning:
    """The first window: encodings and prediction, the current frame first, the oldest second.

    waiting: the other frames since the oldest, oldest first; some may be newer than the current
    one. measured: false where the model never saw depth and the map begins on its prior alone.
    """

    encodings: tuple[FrameEncoding, ...]
    prediction: WindowPrediction
    waiting: tuple[Frame, ...]
    measured: bool


class Initialisation:
    """Waits until the model can answer; a model that needs one view only answers at once."""

    def __init__(self, config: InitialisationConfig, camera_config: CameraConfig,
                 window: WindowTracker, min_seen: float) -> None:
        self._config = config
        self._fov_deg = camera_config.fov_deg
        self._window_tracker = window
        self._min_seen = min_seen
        self._offered = 0
        self._wanted_px: float = config.min_parallax_px
        self._frames: list[Frame] = []
        self._asked: tuple[Frame, ...] = ()
        self._asked_px = 0.0
        self._restart()

    def offer(self, frame: Frame, clock: Stopwatch) -> bool:
        """One more image; whether it is time to ask the model about the window."""
        self._offered += 1
        if self._window_tracker.min_views == 1:
            self._frames = [frame]
            return True
        with clock.stage('follow'):
            self._parallax_px = self._track(frame) * 518.0 / frame.width
        return len(self._frames) >= self._window_tracker.min_views \
            and (self._parallax_px >= self._wanted_px or self._late)

    def window(self) -> tuple[Frame, ...]:
        """What to ask about: the newest frame, the oldest, and up to two spread between them."""
        self._asked_px, self._asked = self._parallax_px, tuple(self._frames)
        if len(self._frames) == 1:
            return (self._frames[0],)
        between = self._frames[1:-1]
        middle = [between[len(between) * k // 3] for k in (1, 2)] if len(between) > 2 else between
        return (self._frames[-1], self._frames[0], *middle)

    def infer(self, frames: Sequence[Frame], clock: Stopwatch) -> Inferred:
        """The model's answer about a window; changes nothing here."""
        encodings = tuple(self._window_tracker.encode(frame, clock) for frame in frames)
        return Inferred(encodings, self._window_tracker.infer(encodings, clock))

    def begin(self, inferred: Inferred) -> Beginning | None:
        """The beginning, unless the answer shows that it is too early."""
        prediction = inferred.prediction
        views = range(min(2, len(inferred.encodings)))
        seen = min(prediction.seen_share(view) for view in views)
        measured = seen >= self._min_seen and not prediction.rotation_only
        if self._window_tracker.min_views == 1 or measured or self._late:
            return Beginning(inferred.encodings, prediction, self._waiting(inferred.encodings),
                             measured)
        self._wanted_px = min(_PATIENCE * max(self._wanted_px, self._asked_px),
                              _MOST * self._config.min_parallax_px)
        return None

    @property
    def _late(self) -> bool:
        return self._offered >= self._config.max_frames

    def _waiting(self, encodings: Sequence[FrameEncoding]) -> tuple[Frame, ...]:
        """Of those there were when the model was asked, and of those that came since."""
        newest_ns = encodings[0].frame.stamp_ns
        since = (frame for frame in self._frames if frame.stamp_ns > newest_ns)
        return (*self._asked[1:-1], *since)

    def _restart(self) -> None:
        self._frames = []
        self._grey: np.ndarray | None = None
        self._uv_first = np.zeros((0, 2), np.float32)
        self._uv = self._uv_first
        self._started_with = 0
        self._parallax_px = 0.0

    def _track(self, frame: Frame) -> float:
        """Follow the first image's corners one image further; their parallax in pixels."""
        if self._grey is not None and len(self._uv):
            matches = refine(self._grey, frame.grey, self._uv, self._uv, max_move_px=90.0)
            self._uv_first = self._uv_first[matches.valid]
            self._uv = matches.uv_b[matches.valid]
        if len(self._uv) < max(_FEWEST_TRACKS * self._started_with, 30):
            self._begin_from(frame)
        self._grey = frame.grey
        self._frames.append(frame)
        if len(self._frames) > self._config.max_frames:     # a slow model: none of them is needed
            del self._frames[1]
        return self._parallax(frame)

    def _begin_from(self, frame: Frame) -> None:
        self._restart()
        corners = cv2.goodFeaturesToTrack(frame.grey, 400, 0.003, 9)
        if corners is not None:
            self._uv_first = self._uv = corners[:, 0]
        self._started_with = len(self._uv)

    def _parallax(self, frame: Frame) -> float:
        if len(self._frames) < 2 or len(self._uv) < 30:
            return 0.0
        K = frame.K if frame.K is not None else camera.intrinsics_from_fov(
            frame.width, frame.height, self._fov_deg, frame.aspect)
        a, b = (rotation.unit_rays(torch.from_numpy(uv), K) for uv in (self._uv_first, self._uv))
        return rotation.parallax_px(a, b, rotation.fit_rotation(a, b), float(K[0, 0]))
