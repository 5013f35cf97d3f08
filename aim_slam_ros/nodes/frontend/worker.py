"""The thread that drives the frontend: the newest image, then whatever else there is to do."""

from __future__ import annotations

import secrets
import threading
import time
import traceback
from collections import deque
from typing import Callable

import numpy as np
from rclpy.impl.rcutils_logger import RcutilsLogger

from msg_adapters.encodings import rgb_from_compressed, rgb_from_image
from msg_adapters.errors import MessageError
from msg_adapters.keyframes import ReceivedCorrection
from msg_adapters.stamps import stamp_ns

from ...config import Config
from ...frontend.concurrent import ConcurrentFrontend, ModelFailure, PlacedResult
from ...models.base import GeometryModel
from ...types import FrameResult, TrackingStatus
from .image_input import ArrivedImage
from .output import FrontendOutput
from .parameters import FrontendParameters
from .statistics import FrontendStatistics

_BACKWARDS_NS = 500_000_000   # so far back in time is another beginning, not a late image
_PERIOD_S = 5.0               # a complaint is repeated this often at most
_NEVER = -1


class FrontendWorker:
    """Owns the frontend. Callbacks put things here and return at once."""

    def __init__(self, config: Config, parameters: FrontendParameters, model: GeometryModel,
                 output: FrontendOutput, statistics: FrontendStatistics, logger: RcutilsLogger,
                 K_of: Callable[[int, int], np.ndarray | None]) -> None:
        """K_of: the intrinsics for images of this width and height, where known."""
        self._config = config
        self._parameters = parameters
        self._model = model
        self._output = output
        self._statistics = statistics
        self._logger = logger
        self._K_of = K_of
        self._decode = rgb_from_compressed if parameters.image_transport == 'compressed' \
            else rgb_from_image
        self._wake = threading.Condition()
        self._image: ArrivedImage | None = None
        self._correction: ReceivedCorrection | None = None
        self._answered = self._resend = self._reset = self._closed = False
        self._resending: deque[int] = deque()
        self._next_resend_s = 0.0
        self._begin()
        self._thread = threading.Thread(target=self._run, name='frontend', daemon=True)
        self._thread.start()

    @property
    def session_id(self) -> int:
        return self._session_id

    @property
    def frontend(self) -> ConcurrentFrontend:
        """For what it knows; this thread alone drives it."""
        return self._frontend

    def offer(self, image: ArrivedImage) -> None:
        """The newest image wins; one that still waits is dropped and counted."""
        with self._wake:
            self._statistics.arrived(replaced=self._image is not None)
            self._image = image
            self._wake.notify()

    def correct(self, received: ReceivedCorrection) -> None:
        with self._wake:
            self._correction = received
            self._wake.notify()

    def resend(self) -> int:
        """Publish every keyframe once more, a few per second; how many there are."""
        with self._wake:
            self._resend = True
            self._wake.notify()
        return len(self._frontend.pipeline.keyframes)

    def reset(self) -> None:
        """Forget everything; the next image begins a new map."""
        with self._wake:
            self._reset = True
            self._wake.notify()

    def close(self) -> None:
        with self._wake:
            self._closed = True
            self._wake.notify()
        self._frontend.close()
        self._thread.join(timeout=1.0)

    def _begin(self) -> None:
        self._session_id = secrets.randbits(32)
        self._last_ns = _NEVER
        self._arrived_s: dict[int, float] = {}
        self._said_s: dict[str, float] = {}
        self._resending.clear()
        self._frontend = ConcurrentFrontend(self._config, self._model, self._on_answer)

    def _on_answer(self) -> None:
        with self._wake:
            self._answered = True
            self._wake.notify()

    def _run(self) -> None:
        while self._wait():
            try:
                self._turn()
            except Exception:   # one image must not end a robot's localisation
                self._statistics.errors += 1
                self._logger.error('an image failed and is skipped; please report this:\n'
                                   + traceback.format_exc())

    def _wait(self) -> bool:
        """Until there is something to do; False at the end."""
        with self._wake:
            self._wake.wait_for(self._has_work, self._pause_s())
            return not self._closed

    def _has_work(self) -> bool:
        return bool(self._image or self._correction or self._answered or self._resend
                    or self._reset or self._closed)

    def _pause_s(self) -> float | None:
        return max(0.0, self._next_resend_s - time.monotonic()) if self._resending else None

    def _turn(self) -> None:
        with self._wake:
            image, self._image = self._image, None
            received, self._correction = self._correction, None
            reset, self._reset = self._reset, False
            resend, self._resend = self._resend, False
            self._answered = False
        if reset:
            self._restart()
        if received is not None:
            self._take_correction(received)
        if resend:
            # First the one that images refer to now: by it they are placed in the map.
            newest = self._frontend.pipeline.reference_id
            self._resending = deque(sorted(
                (k.keyframe_id for k in self._frontend.pipeline.keyframes),
                key=lambda i: (i != newest, i)))
        self._collect()
        if image is not None:
            self._take_image(image)
        self._resend_one()

    def _collect(self) -> None:
        """What the model found; where it failed, images go on being followed without it."""
        try:
            self._publish(self._frontend.collect())
        except ModelFailure as failure:
            self._statistics.model_errors += 1
            if self._is_time_to_say('model'):
                self._logger.error(
                    f'{failure}; images are followed without it meanwhile. Unless it is for want '
                    'of memory, please report this:\n'
                    + ''.join(traceback.format_exception(failure.__cause__)))
            if failure.result is not None:
                self._publish([self._frontend.unplaced(failure.result)])

    def _restart(self) -> None:
        self._frontend.close()
        self._statistics.resets += 1
        self._output.restart()
        self._begin()

    def _take_correction(self, received: ReceivedCorrection) -> None:
        """A latched one may be of a frontend that ran before."""
        if received.session_id == self._session_id:
            self._frontend.correct(received.corrected)

    def _take_image(self, arrived: ArrivedImage) -> None:
        stamp = stamp_ns(arrived.message.header.stamp)
        self._output.saw_frame_id(arrived.message.header.frame_id)
        try:
            if stamp <= 0:
                raise MessageError('header.stamp is 0: the driver must set it')
            image = self._decode(arrived.message)
        except MessageError as error:
            skipped = FrameResult(stamp, TrackingStatus.SKIPPED, reason=str(error))
            self._publish([self._frontend.unplaced(skipped)])
            return
        if stamp < self._last_ns - _BACKWARDS_NS:
            self._logger.warning(
                f'time went back by {(self._last_ns - stamp) / 1e9:.1f} s (a bag played again?): '
                'a new map begins')
            self._restart()
        self._last_ns = max(self._last_ns, stamp)
        self._arrived_s[stamp] = arrived.arrived_s
        height, width = image.shape[:2]
        self._publish(self._frontend.process(stamp, image, self._K_of(width, height)))

    def _publish(self, results: list[PlacedResult]) -> None:
        for placed in results:
            posed = self._output.publish(placed, self._session_id, self._statistics.dropped)
            self._statistics.took(placed.result, placed.again)
            if posed and placed.result.stamp_ns in self._arrived_s:
                self._statistics.posed(self._arrived_s[placed.result.stamp_ns])
            self._say(placed.result)
        while len(self._arrived_s) > 100:
            del self._arrived_s[next(iter(self._arrived_s))]

    def _say(self, result: FrameResult) -> None:
        """Why an image was skipped or lost, and when tracking goes on; not for each image."""
        tracked, lost = (result.status is s for s in (TrackingStatus.TRACKED, TrackingStatus.LOST))
        if tracked and TrackingStatus.LOST.value in self._said_s:
            del self._said_s[TrackingStatus.LOST.value]
            self._logger.info('tracking again')
        if not lost and result.status is not TrackingStatus.SKIPPED:
            return
        if self._is_time_to_say(result.status.value):
            self._logger.warning(f'image {result.status.value}: {result.reason}')

    def _is_time_to_say(self, what: str) -> bool:
        now = time.monotonic()
        if now - self._said_s.get(what, -_PERIOD_S) < _PERIOD_S:
            return False
        self._said_s[what] = now
        return True

    def _resend_one(self) -> None:
        now = time.monotonic()
        if self._resending and now >= self._next_resend_s:
            self._next_resend_s = now + 1.0 / self._parameters.resend_hz
            self._output.publish_event(self._frontend.event(self._resending.popleft()),
                                       self._session_id)
