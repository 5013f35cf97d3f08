"""The thread that builds the map: one keyframe after another, and what is published of it."""

from __future__ import annotations

import threading
import time
import traceback
from functools import partial
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Callable

from rclpy.impl.rcutils_logger import RcutilsLogger
from rclpy.task import Future

from ...config import Config
from ...loop_closure.pose_graph import PoseGraphError
from ...loop_closure.retrieval import RetrievalError
from ...types import KeyframeEvent
from .map_files import MapFilesError, save
from .map_session import MapSession
from .output import LoopClosureOutput
from .pacer import Pacer
from .parameters import LoopClosureParameters
from .statistics import LoopClosureStatistics

_CAPACITY = 100         # keyframes that may wait, some megabytes each; the frontend has them all
_TICK_S = 0.1           # how often it looks whether something is due
_GRACE_S = 10.0         # so long a map that is due lets keyframes go first


class MapWorker:
    """Owns the pipelines. Callbacks put things here and return at once."""

    def __init__(self, config: Config, parameters: LoopClosureParameters,
                 output: LoopClosureOutput, statistics: LoopClosureStatistics,
                 logger: RcutilsLogger) -> None:
        self._config = config
        self._parameters = parameters
        self._output = output
        self._statistics = statistics
        self._logger = logger
        self._session: MapSession | None = None
        self._tasks: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._added = self._done = 0    # each written by one thread alone
        self._closed = False
        self._path_pace = Pacer(parameters.path_period_s)
        self._map_pace = Pacer(parameters.map_period_s)
        self._thread = threading.Thread(target=self._run, name='map', daemon=True)
        self._thread.start()

    @property
    def pending(self) -> int:
        """Keyframes that wait, and the one at work."""
        return self._added - self._done

    def add(self, session: MapSession, event: KeyframeEvent) -> bool:
        """Queue a keyframe; False where the queue is full: it must be asked for again."""
        if self.pending >= _CAPACITY:
            return False
        self._added += 1
        self._tasks.put(partial(self._add, session, event, time.monotonic()))
        return True

    def moved(self) -> None:
        """A frame was added to the path."""
        self._path_pace.change()

    def begin(self, session: MapSession) -> None:
        """From now on this is the map that is published."""
        self._tasks.put(partial(self._begin, session))

    def save(self, session: MapSession) -> Future:
        """Once what waits is done: the Future's result is the folder, or a MapFilesError."""
        future: Future = Future()
        self._tasks.put(partial(self._save, session, future))
        return future

    def close(self) -> None:
        """End the thread; an inference at work is left to end with the process."""
        self._closed = True
        self._tasks.put(lambda: None)
        self._thread.join(timeout=1.0)

    def _run(self) -> None:
        while not self._closed:
            try:
                task = self._tasks.get(timeout=_TICK_S)
            except Empty:
                task = None
            try:
                if task is not None:
                    task()
                self._publish()
            except Exception:   # one keyframe must not end the map of a robot
                self._statistics.unusable_keyframes += 1
                self._logger.error('a keyframe or the map failed and is passed over; please '
                                   'report this:\n' + traceback.format_exc())

    def _begin(self, session: MapSession) -> None:
        self._session = session
        self._path_pace.change()
        self._map_pace.change()

    def _add(self, session: MapSession, event: KeyframeEvent, arrived_s: float) -> None:
        try:
            if not session.forgotten and session.wants(event):
                self._take(session, event)
                self._statistics.latency_s = time.monotonic() - arrived_s
        finally:
            self._done += 1

    def _take(self, session: MapSession, event: KeyframeEvent) -> None:
        try:
            corrected = session.add(event)
        except (PoseGraphError, RetrievalError) as error:
            self._statistics.unusable_keyframes += 1
            self._logger.warning(f'keyframe {event.keyframe_id} is not used: {error}',
                                 throttle_duration_sec=5.0)
            return
        if session.forgotten:
            return
        if corrected is not None:
            self._output.correction(corrected, session)
            self._logger.info(f'keyframe {event.keyframe_id} saw an old place again: '
                              f'correction {corrected.version}')
        self._path_pace.change()
        self._map_pace.change()

    def _save(self, session: MapSession, future: Future) -> None:
        result: Path | MapFilesError = MapFilesError('it failed unexpectedly: see the log')
        try:
            result = save(session, self._config, self._parameters.save_directory)
        except MapFilesError as error:
            result = error
        finally:
            future.set_result(result)

    def _publish(self) -> None:
        """What is due; the map, which takes longest, lets keyframes go first for a while."""
        session = self._session
        if session is None or self._closed:
            return
        if self._path_pace.due():
            self._path_pace.begin()
            self._output.path(session)
            self._path_pace.end()
        if self._map_pace.due(grace_s=_GRACE_S if self.pending else 0.0):
            self._map_pace.begin()
            self._output.map(session)
            self._map_pace.end()
