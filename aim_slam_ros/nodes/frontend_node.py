"""The frontend node: images in; poses, odometry, points and keyframes out."""

from __future__ import annotations

from typing import Any, Callable

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import Trigger

from msg_adapters import diagnostics, keyframes
from msg_adapters.errors import MessageError

from ..models import make_model
from ..models.base import GeometryModel
from ..types import TrackingStatus
from .frontend.image_input import CameraInfoInput, ImageInput, image_topic
from .frontend.output import FrontendOutput
from .frontend.parameters import FrontendParameters
from .frontend.statistics import FrontendStatistics
from .frontend.worker import FrontendWorker
from .loop_closure.parameters import LoopClosureParameters
from .parameters import declare_config, declare_section, warn_of_unknown


class FrontendNode(Node):
    """Callbacks hand over to the worker thread; the worker publishes."""

    def __init__(self, wrap: Callable[[GeometryModel], GeometryModel] = lambda m: m) -> None:
        """wrap: what is put around the model that the parameters name."""
        super().__init__('frontend')
        parameters = declare_section(self, FrontendParameters)
        config = declare_config(self)
        warn_of_unknown(self, LoopClosureParameters)
        self._statistics = FrontendStatistics()
        output = FrontendOutput(self, parameters)
        info = CameraInfoInput(self, config.camera.use_calibration,
                               self.resolve_topic_name(image_topic(parameters)))
        self.model = wrap(make_model(config))
        self._worker = FrontendWorker(config, parameters, self.model, output, self._statistics,
                                      self.get_logger(), info.K)
        self._images = ImageInput(self, parameters, self._worker.offer)
        self._subscribe_corrections()
        self.create_service(Trigger, '~/resend_keyframes', self._resend_keyframes)
        self.create_service(Trigger, '~/reset', self._reset)
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        # Not of the node's clock: simulated time may stand still.
        self.create_timer(1.0, self._diagnose, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self.get_logger().info(f'model {config.model.name}; waiting for images on '
                               f'{self._images.topic}')

    def close(self) -> None:
        """End the worker; a model at work is left to end with the process."""
        self._worker.close()

    def _subscribe_corrections(self) -> None:
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.create_subscription(
            PointCloud2, 'keyframe_poses', self._correct, latched,
            qos_overriding_options=QoSOverridingOptions.with_default_policies())

    def _correct(self, message: PointCloud2) -> None:
        try:
            self._worker.correct(keyframes.correction(message))
        except MessageError as error:
            self.get_logger().error(f'corrected keyframe poses are not used: {error}',
                                    throttle_duration_sec=5.0)

    def _resend_keyframes(self, request: Any, response: Trigger.Response) -> Trigger.Response:
        count = self._worker.resend()
        response.success, response.message = True, f'{count} keyframes follow'
        return response

    def _reset(self, request: Any, response: Trigger.Response) -> Trigger.Response:
        self._worker.reset()
        response.success, response.message = True, 'the next image begins a new map'
        return response

    def _diagnose(self) -> None:
        pipeline = self._worker.frontend.pipeline
        values = self._statistics.values() | {
            'keyframes': len(pipeline.keyframes),
            'map_pieces': len({k.piece_id for k in pipeline.keyframes}),
            'model_busy': str(self._worker.frontend.busy).lower(),
            'session': self._worker.session_id}
        level, text = self._condition()
        self._diagnostics.publish(diagnostics.diagnostics_msg(
            f'{self.get_fully_qualified_name()}: tracking', level, text, values,
            self.get_clock().now().nanoseconds))

    def _condition(self) -> tuple[bytes, str]:
        last = self._statistics.last
        if self._images.silent or last is None:
            return DiagnosticStatus.WARN, 'no images come'
        if last.status is TrackingStatus.TRACKED:
            return DiagnosticStatus.OK, 'tracked'
        return DiagnosticStatus.WARN, f'{last.status.value}: {last.reason}'
