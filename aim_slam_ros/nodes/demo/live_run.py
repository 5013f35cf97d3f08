"""A bag through both nodes over DDS: processes started, images played, topics heard, all ended."""

from __future__ import annotations

import os
import threading
import time
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Callable, Iterator, Mapping, Protocol

import rclpy
import yaml
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from ...datasets.bag_topics import COMPRESSED, ChosenTopics
from ...datasets.base import DatasetError
from ...evaluation.received_run import ReceivedRun
from ..replay.player import Player, PlayError, PlayOptions, Published
from .collector import Collector
from .overview import NOTHING, Overview, overview
from .processes import NodeProcess, executable, stop
from .received import Playback, received_run
from .settling import frontend_is_idle, loop_closure_is_idle

NODES = ('frontend', 'loop_closure')
_START_S = 120.0    # a large model takes its time to load
_SETTLE_S = 120.0
_LOOK_S = 0.1
_OVERVIEW_S = 0.5   # reading the newest messages costs the player a few milliseconds


class NodeDied(RuntimeError):
    """A node ended by itself, or never came to life."""


@dataclass(frozen=True)
class LiveBag:
    """What is played. topics: the bag's images and their camera_info."""

    path: Path
    topics: ChosenTopics


@dataclass(frozen=True)
class LiveResult:
    """run: what was heard. failure: why the run could not go on, or None.

    problems: what a person should know besides, one line each.
    """

    run: ReceivedRun
    failure: str | None
    problems: tuple[str, ...]


class Listener(Protocol):
    """Who wants to know how far it is."""

    def say(self, text: str) -> None:
        """A line about what goes on."""

    def show(self, overview: Overview) -> None:
        """An image was played."""


def run_live(bag: LiveBag, settings: Mapping[str, Any], out: Path, rate: float,
             listener: Listener) -> LiveResult:
    """Play it and gather what both nodes publish until they have nothing left to do.

    settings: parameters of both nodes, nested by section. out: gets parameters.yaml and the logs.
    rate: times real time. Ctrl-C (KeyboardInterrupt) ends the playing; what was heard until then
    is returned. The ROS domain is that of the environment. Raises PlayError and DatasetError for
    a bag that cannot be played at all.
    """
    parameters = _write_parameters(out / 'parameters.yaml', bag, settings)
    arguments = ['--ros-args', '--params-file', str(parameters)]
    processes = [NodeProcess(name, [*executable(name), *arguments], out / f'{name}.log',
                             os.environ) for name in NODES]
    try:
        with _rclpy():
            return _LiveRun(bag, rate, processes, listener).result()
    finally:
        stop(processes)


def _write_parameters(path: Path, bag: LiveBag, settings: Mapping[str, Any]) -> Path:
    compressed = bag.topics.image.msgtype == COMPRESSED
    values = {**settings, 'image_transport': 'compressed' if compressed else 'raw'}
    path.write_text(yaml.safe_dump({'/**': {'ros__parameters': values}}, sort_keys=False),
                    encoding='utf-8')
    return path


@contextmanager
def _rclpy() -> Iterator[None]:
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    try:
        yield
    finally:
        rclpy.try_shutdown()


def _image_topic(topics: ChosenTopics) -> str:
    """Where the frontend awaits images."""
    return 'image/compressed' if topics.image.msgtype == COMPRESSED else 'image'


def _player_node(topics: ChosenTopics) -> Node:
    """Whatever the bag calls them: the frontend subscribes image and camera_info."""
    remappings = {topics.image.name: f'/{_image_topic(topics)}'}
    if topics.camera_info is not None:
        remappings[topics.camera_info.name] = '/camera_info'
    rules = [word for old, new in remappings.items() if old != new
             for word in ('-r', f'{old}:={new}')]
    return Node('player', cli_args=['--ros-args', *rules] if rules else None)


class _LiveRun:
    """From nodes that were just started to what they have left behind."""

    def __init__(self, bag: LiveBag, rate: float, processes: list[NodeProcess],
                 listener: Listener) -> None:
        self._processes = processes
        self._listener = listener
        self._collector = Collector()
        self._topics = self._collector.topics
        self._node = _player_node(bag.topics)
        self._image_topic = _image_topic(bag.topics)
        names = tuple(t.name for t in (bag.topics.image, bag.topics.camera_info) if t)
        self._player = Player(self._node, bag.path, PlayOptions(rate=rate, topics=names))
        # Set with the last image: the player would wait for it to be acknowledged, and while it
        # does so no other thread of this process can take a message.
        self._played = threading.Event()
        self._published_ns: dict[int, int] = {}
        self._images, self._last_ns = 0, 0
        self._overview, self._looked_s = NOTHING, 0.0
        self._problems: list[str] = []

    def result(self) -> LiveResult:
        """Play, wait for the end of the work, end the nodes."""
        interrupted, failure = False, None
        try:
            self._await_nodes()
            self._player.play(self._take, self._played)
            self._settle()
        except KeyboardInterrupt:
            interrupted = True
        except (NodeDied, PlayError, DatasetError) as error:
            failure = str(error)
        ended = stop(self._processes)
        if failure is None:
            self._problems += [end.problem for end in ended if end.problem]
        self._collector.close()
        self._player.close()
        self._node.destroy_node()
        played = Playback(self._published_ns, self._images, interrupted)
        return LiveResult(received_run(self._topics, played), failure, tuple(self._problems))

    def _take(self, published: Published) -> None:
        """An image has left."""
        self._check_alive()
        if not published.is_image:
            return
        self._published_ns.setdefault(published.stamp_ns, published.monotonic_ns)
        self._images, self._last_ns = self._images + 1, published.stamp_ns
        if self._images == self._player.images:
            self._played.set()
        if time.monotonic() - self._looked_s > _OVERVIEW_S:
            self._overview, self._looked_s = overview(self._topics), time.monotonic()
        self._listener.show(self._overview)

    def _await_nodes(self) -> None:
        """Everybody has found everybody; raises NodeDied where that takes too long."""
        self._listener.say('waiting for the nodes')
        if self._waited(lambda: not self._missing(), _START_S):
            # What the graph knows, the publisher may not know yet.
            self._player.wait_for_subscriber(_START_S)
            return
        logs = ', '.join(str(process.log) for process in self._processes)
        raise NodeDied(f'after {_START_S:.0f} s nobody has {", ".join(self._missing())}: '
                       f'see {logs}')

    def _missing(self) -> list[str]:
        return self._collector.missing([self._image_topic, 'keyframe_cloud', 'keyframe_poses'])

    def _settle(self) -> None:
        """The last image was played: wait for what is still to come of it."""
        self._listener.say('played; waiting until both nodes have finished')
        if not self._waited(lambda: frontend_is_idle(self._topics, self._last_ns), _SETTLE_S):
            self._problems.append(f'the frontend was still at work after {_SETTLE_S:.0f} s: '
                                  'the end is missing')
        elif not self._waited(lambda: loop_closure_is_idle(self._topics), _SETTLE_S):
            self._problems.append(f'loop closure was still at work after {_SETTLE_S:.0f} s: path '
                                  'and map lack the end')

    def _waited(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        """Whether it came true in time; raises NodeDied."""
        deadline_s = time.monotonic() + timeout_s
        while not condition():
            self._check_alive()
            if time.monotonic() > deadline_s:
                return False
            time.sleep(_LOOK_S)
        return True

    def _check_alive(self) -> None:
        for process in self._processes:
            if not process.alive:
                raise NodeDied(f'{process.name} ended by itself with status {process.code}; the '
                               f'end of {process.log}:\n{process.tail()}')
