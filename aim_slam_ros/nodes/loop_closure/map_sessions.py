"""Which run of the frontend a message belongs to; each has a map of its own."""

from __future__ import annotations

from rclpy.impl.rcutils_logger import RcutilsLogger
from rclpy.task import Future

from ...config import Config
from ...models.base import GeometryModel
from .map_files import MapFilesError
from .map_session import MapSession
from .map_worker import MapWorker
from .output import LoopClosureOutput
from .parameters import LoopClosureParameters


class MapSessions:
    """The current map, and the ids of those that are over. For the callbacks' thread."""

    def __init__(self, config: Config, parameters: LoopClosureParameters, model: GeometryModel,
                 worker: MapWorker, output: LoopClosureOutput, logger: RcutilsLogger) -> None:
        self._config = config
        self._parameters = parameters
        self._model = model
        self._worker = worker
        self._output = output
        self._logger = logger
        self._past: set[int] = set()
        self.current: MapSession | None = None
        self.late_messages = 0      # of runs that are over

    def of(self, session_id: int) -> MapSession | None:
        """The map that a message belongs to; None of a run that is over.

        An id that was never seen begins a map.
        """
        current = self.current
        if current is not None and session_id == current.session_id:
            return current
        if session_id in self._past:
            self.late_messages += 1
            return None
        if current is not None:
            self._past.add(current.session_id)
            self._end(current)
        return self._begin(self._new(session_id))

    def restart(self) -> None:
        """Forget the current map's keyframes; the frames of its path stay."""
        old = self.current
        if old is not None:
            old.forgotten = True
            self._begin(self._new(old.session_id, old))

    def _new(self, session_id: int, before: MapSession | None = None) -> MapSession:
        return MapSession(session_id, self._config, self._model, self._parameters.gap_s,
                          before.path if before is not None else None)

    def _begin(self, session: MapSession) -> MapSession:
        self.current = session
        self._output.restart()
        self._worker.begin(session)
        return session

    def _end(self, session: MapSession) -> None:
        keep = self._parameters.save_on_new_session and session.keyframes > 0
        self._logger.warning(
            'the frontend was restarted or reset: a new map begins; the old one of '
            f'{session.keyframes} keyframes is ' + ('saved' if keep else 'forgotten'))
        if keep:
            self._worker.save(session).add_done_callback(self._say_saved)
        else:
            session.forgotten = True

    def _say_saved(self, future: Future) -> None:
        result = future.result()
        if isinstance(result, MapFilesError):
            self._logger.error(f'the old map is lost: {result}')
        else:
            self._logger.info(f'the old map was saved in {result}')
