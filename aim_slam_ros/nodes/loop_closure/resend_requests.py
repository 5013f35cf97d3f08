"""Asks the frontend for all its keyframes, without ever waiting for it."""

from __future__ import annotations

import time

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import Trigger

_PERIOD_S = 0.5
_TIMEOUT_S = 5.0        # of an answer: the frontend may have been killed after the call


class ResendRequests:
    """Remembers that keyframes are wanted until a frontend has said that it sends them."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._client = node.create_client(Trigger, 'frontend/resend_keyframes')
        self._wanted = False
        self._absence_said = self._present = False
        self._future: Future | None = None
        self._asked_s = 0.0
        node.create_timer(_PERIOD_S, self._turn, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def want(self) -> None:
        """As soon as there is a frontend, and once."""
        self._wanted = True

    def _turn(self) -> None:
        if self._future is not None:
            self._look_after(self._future)
        elif self._wanted:
            self._ask()

    def _ask(self) -> None:
        if not self._client.service_is_ready():
            self._present = False
            if not self._absence_said:
                self._absence_said = True
                self._node.get_logger().info(
                    f'no frontend at {self._client.srv_name} yet: as soon as there is one it is '
                    'asked for its keyframes')
            return
        if not self._present:       # its publishers are found a moment after its service
            self._present = True
            return
        self._wanted = self._present = self._absence_said = False
        self._asked_s = time.monotonic()
        self._future = self._client.call_async(Trigger.Request())

    def _look_after(self, future: Future) -> None:
        if future.done():
            self._future = None
            answer = future.result()
            self._wanted |= not answer.success
            self._node.get_logger().info(f'asked the frontend for its keyframes: {answer.message}')
        elif time.monotonic() - self._asked_s > _TIMEOUT_S:
            self._client.remove_pending_request(future)
            self._future, self._wanted = None, True
