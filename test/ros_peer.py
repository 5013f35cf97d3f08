"""Real processes and a real peer: what the tests of the nodes are made with."""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import TracebackType
from typing import Any, Callable

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile

ROOT = Path(__file__).resolve().parents[1]
PATIENCE_S = 30.0   # on a busy machine a process takes 10 s until it is up
_numbers = itertools.count()


def wait_for(condition: Callable[[], Any], what: str, timeout_s: float = PATIENCE_S) -> None:
    """Look again until it holds."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, f'waited {timeout_s:.0f} s in vain for {what}'
        time.sleep(0.01)


class Process:
    """A module of ours as an OS process; its output is kept in a file."""

    def __init__(self, log: Path, module: str, *arguments: str,
                 environment: dict[str, str] | None = None) -> None:
        self.log = log
        path = os.pathsep.join([str(ROOT), str(ROOT / 'test'), os.environ.get('PYTHONPATH', '')])
        with log.open('w', encoding='utf-8') as output:
            self._process = subprocess.Popen(
                [sys.executable, '-m', module, *arguments], stdout=output, text=True,
                stderr=subprocess.STDOUT, cwd=log.parent,
                env=os.environ | {'PYTHONPATH': path, 'PYTHONUNBUFFERED': '1'}
                | (environment or {}))

    def __enter__(self) -> Process:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        if self._process.poll() is None:
            self._process.kill()
        self._process.wait()
        if error is not None:
            print(f'--- {self.log.name}\n{self.output}')

    @property
    def output(self) -> str:
        return self.log.read_text(encoding='utf-8')

    @property
    def alive(self) -> bool:
        return self._process.poll() is None

    def kill(self) -> None:
        """As kill -9 does."""
        self._process.kill()
        self._process.wait()

    def signal(self, number: int = signal.SIGINT) -> None:
        self._process.send_signal(number)

    def ended(self, timeout_s: float = PATIENCE_S) -> int:
        """The exit status, once there is one."""
        return self._process.wait(timeout_s)

    def says(self, text: str, timeout_s: float = PATIENCE_S) -> None:
        wait_for(lambda: text in self.output, f'{text!r} in {self.log.name}:\n{self.output}',
                 timeout_s)


class Peer:
    """A node of the test's own process, spun in a thread, that remembers what it hears."""

    def __init__(self) -> None:
        self.context = Context()
        rclpy.init(context=self.context)
        self.node = Node(f'peer_{next(_numbers)}', context=self.context)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._ended = False
        self._thread.start()

    def __enter__(self) -> Peer:
        return self

    def __exit__(self, *unused: Any) -> None:
        self._ended = True
        self._thread.join(timeout=5.0)
        self._executor.shutdown(timeout_sec=0)
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)

    def _spin(self) -> None:
        while not self._ended:
            self._executor.spin_once(timeout_sec=0.05)

    def hear(self, kind: Any, topic: str, quality: QoSProfile | int = 200) -> list[Any]:
        """Every message of a topic from now on, in a list that grows."""
        heard: list[Any] = []
        self.node.create_subscription(kind, topic, heard.append, quality)
        return heard

    def publisher(self, kind: Any, topic: str, quality: QoSProfile | int = 20,
                  listeners: int = 1) -> Any:
        """A publisher that somebody listens to by now."""
        made = self.node.create_publisher(kind, topic, quality)
        wait_for(lambda: made.get_subscription_count() >= listeners,
                 f'a subscriber of {made.topic_name}')
        return made

    def call(self, kind: Any, service: str) -> Any:
        """A service's answer."""
        client = self.node.create_client(kind, service)
        assert client.wait_for_service(PATIENCE_S), f'no service {service}'
        future = client.call_async(kind.Request())
        wait_for(future.done, f'an answer of {service}')
        return future.result()
