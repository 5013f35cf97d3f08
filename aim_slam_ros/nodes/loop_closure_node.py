"""The loop-closure node: keyframes and frames in; corrected poses, path and map out."""

from __future__ import annotations

import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import Trigger

from msg_adapters import diagnostics, frames, keyframes
from msg_adapters.errors import MessageError

from ..models import make_model
from ..models.base import GeometryModel
from .frontend.parameters import FrontendParameters
from .loop_closure.keyframe_pairs import KeyframePair, KeyframePairs
from .loop_closure.map_files import MapFilesError
from .loop_closure.map_sessions import MapSessions
from .loop_closure.map_worker import MapWorker
from .loop_closure.output import LoopClosureOutput
from .loop_closure.parameters import LoopClosureParameters
from .loop_closure.resend_requests import ResendRequests
from .loop_closure.statistics import LoopClosureStatistics, map_values
from .parameters import declare_config, declare_section, warn_of_unknown

_MANY_PENDING = 10      # so many waiting keyframes are worth a warning
_PERIOD_S = 5.0         # a complaint about messages is repeated this often at most


class LoopClosureNode(Node):
    """Callbacks place frames and hand keyframes to the worker thread, which publishes the map."""

    def __init__(self, model: GeometryModel | None = None) -> None:
        """model: one that is shared with another node; else the one that the parameters name."""
        super().__init__('loop_closure')
        self._settings = declare_section(self, LoopClosureParameters)
        self._config = declare_config(self)
        warn_of_unknown(self, FrontendParameters)
        model = make_model(self._config) if model is None else model
        self._pairs = KeyframePairs()
        self._statistics = LoopClosureStatistics()
        self._output = LoopClosureOutput(self, self._settings)
        self._worker = MapWorker(self._config, self._settings, self._output, self._statistics,
                                 self.get_logger())
        self._sessions = MapSessions(self._config, self._settings, model, self._worker,
                                     self._output, self.get_logger())
        self._resend = ResendRequests(self)
        self._resend.want()
        self._subscribe('keyframe', lambda message: self._take(self._pairs.table(message)), 20)
        self._subscribe('keyframe_cloud', lambda message: self._take(self._pairs.cloud(message)),
                        20)
        self._subscribe('frame', self._place, 100)
        # A group of its own: while a map is being saved everything else goes on.
        services = ReentrantCallbackGroup()
        self.create_service(Trigger, '~/save_map', self._save, callback_group=services)
        self.create_service(Trigger, '~/reset', self._reset, callback_group=services)
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        # Not of the node's clock: simulated time may stand still.
        self.create_timer(1.0, self._look_around, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self.get_logger().info(f'model {self._config.model.name}; waiting for keyframes on '
                               f'{self.resolve_topic_name("keyframe")}')

    def close(self) -> None:
        """End the worker; an inference at work is left to end with the process."""
        self._worker.close()

    def _take(self, pair: KeyframePair | None) -> None:
        """A keyframe whose two messages are there."""
        self._statistics.hear()
        if pair is None:
            return
        try:
            received = keyframes.keyframe_event(pair.table, pair.cloud)
        except MessageError as error:
            self._refuse(error, 'keyframe')
            return
        session = self._sessions.of(received.session_id)
        if session is None:
            return
        event = received.event
        better = session.knows(event.keyframe_id) and session.wants(event)
        if self._worker.add(session, event):
            session.gaps.received(event.keyframe_id, better)
        else:
            session.gaps.exists(event.keyframe_id)
            self._statistics.dropped_keyframes += 1
        for edge in event.edges:
            session.gaps.exists(max(edge.a, edge.b))

    def _place(self, message: PointCloud2) -> None:
        """A frame: its corrected pose leaves at once, wherever the worker is."""
        self._statistics.hear()
        try:
            report = frames.frame_report(message)
            session = self._sessions.of(report.session_id)
            T_map_cam = session.place(report) if session is not None else None
            if T_map_cam is None or report.T_odom_cam is None:
                return
            self._output.pose(T_map_cam, report.T_odom_cam, report.result.stamp_ns)
        except MessageError as error:
            self._refuse(error, 'frame')
            return
        self._worker.moved()

    async def _save(self, request: Any, response: Trigger.Response) -> Trigger.Response:
        if self._sessions.current is None:
            response.message = 'there is no map yet: nothing came from a frontend'
            return response
        result = await self._worker.save(self._sessions.current)
        response.success = not isinstance(result, MapFilesError)
        response.message = str(result)
        return response

    def _reset(self, request: Any, response: Trigger.Response) -> Trigger.Response:
        response.success = True
        response.message = 'the map begins anew from the keyframes that the frontend has'
        self._sessions.restart()
        self._resend.want()
        return response

    def _look_around(self) -> None:
        """Once a second: gaps among the keyframes, diagnostics."""
        session = self._sessions.current
        if session is not None and session.gaps.overdue(time.monotonic()):
            self.get_logger().warning(f'{session.gaps.missing} keyframes have not come')
            self._resend.want()
        level, text = self._condition()
        self._diagnostics.publish(diagnostics.diagnostics_msg(
            f'{self.get_fully_qualified_name()}: loop closure', level, text,
            self._values(), self.get_clock().now().nanoseconds))

    def _values(self) -> dict[str, str | float | int]:
        return {**self._statistics.values(), 'pending_keyframes': self._worker.pending,
                'unpaired_messages': self._pairs.unpaired,
                'old_session_messages': self._sessions.late_messages,
                **map_values(self._sessions.current)}

    def _condition(self) -> tuple[bytes, str]:
        silence_s = self._statistics.silence_s
        if silence_s is None:
            return diagnostics.OK, 'waiting for the frontend'
        if not self.count_publishers(self.resolve_topic_name('frame')):
            return diagnostics.WARN, 'the frontend is gone'
        if silence_s > self._settings.silence_s:
            return diagnostics.WARN, f'nothing came from the frontend for {silence_s:.0f} s'
        if self._worker.pending > _MANY_PENDING:
            return diagnostics.WARN, f'{self._worker.pending} keyframes wait'
        return diagnostics.OK, 'mapping'

    def _refuse(self, error: MessageError, what: str) -> None:
        self._statistics.unusable_messages += 1
        self.get_logger().warning(f'a {what} is not used: {error}',
                                  throttle_duration_sec=_PERIOD_S)

    def _subscribe(self, topic: str, callback: Any, depth: int) -> None:
        self.create_subscription(
            PointCloud2, topic, callback, QoSProfile(depth=depth),
            qos_overriding_options=QoSOverridingOptions.with_default_policies())
