"""What config/ holds is what the nodes take, publish and need."""

from __future__ import annotations

import dataclasses
import multiprocessing
import subprocess
import sys
import time
from array import array
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Callable, Iterator

import pytest
import yaml

from aim_slam_ros.cli.parameters import NODES, main, parameter_file
from aim_slam_ros.config import Config

rclpy = pytest.importorskip('rclpy', reason='needs ROS 2: make venv installs its wheels')

from rclpy.context import Context       # noqa: E402
from rclpy.node import Node             # noqa: E402
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy   # noqa: E402
from sensor_msgs.msg import Image       # noqa: E402

from aim_slam_ros.nodes.parameters import declare_config, declare_section    # noqa: E402

CONFIG = Path(__file__).resolve().parents[1] / 'config'
TIMEOUT_S = 60.0    # only ever spent where something is broken


@pytest.mark.parametrize('node', NODES)
def test_the_parameter_files_are_up_to_date(node: str, tmp_path: Path) -> None:
    text = (CONFIG / f'{node}.yaml').read_text(encoding='utf-8')
    assert text == parameter_file(node), 'settings were changed: run `make parameters`'
    assert max(len(line) for line in text.splitlines()) <= 99
    assert main([str(tmp_path / 'new')]) == 0
    assert (tmp_path / 'new' / f'{node}.yaml').read_text(encoding='utf-8') == text


@pytest.mark.parametrize('namespace', ['', 'robots/left'])
@pytest.mark.parametrize('node', NODES)
def test_ros_reads_every_parameter_as_its_default(node: str, namespace: str) -> None:
    with _node(node, namespace, CONFIG / f'{node}.yaml') as made:
        assert declare_config(made) == Config()
        assert declare_section(made, NODES[node]) == NODES[node]()
        names = {*Config().settings(), *(f.name for f in _fields(node))}
        assert set(made._parameter_overrides) == names      # as read from the file


def test_a_changed_copy_changes_a_setting_of_its_node_alone(tmp_path: Path) -> None:
    copy = tmp_path / 'mine.yaml'
    copy.write_text(parameter_file('frontend').replace('width: 518', 'width: 392'))
    with _node('frontend', 'robot', CONFIG / 'frontend.yaml', copy) as made:
        assert declare_config(made).camera.width == 392
    with _node('loop_closure', 'robot', copy) as made:
        assert declare_config(made).camera.width == 518


@contextmanager
def _node(name: str, namespace: str, *files: Path) -> Iterator[Node]:
    """A node of its own context that was started with parameter files."""
    context = Context()
    arguments = [word for file in files for word in ('--params-file', str(file))]
    rclpy.init(args=['--ros-args', *arguments], context=context)
    node = Node(name, namespace=namespace, context=context)
    try:
        yield node
    finally:
        node.destroy_node()
        context.try_shutdown()


def _fields(node: str) -> tuple[dataclasses.Field[Any], ...]:
    return dataclasses.fields(NODES[node])  # type: ignore[arg-type]


def test_rviz_shows_what_the_nodes_publish() -> None:
    """Display by display, against a real process with both nodes; RViz itself is not run."""
    displays = {display['Topic']['Value']: display for display in _displays()}
    with _node('onlooker', '') as onlooker:
        process = subprocess.Popen([sys.executable, '-m', 'aim_slam_ros.cli.slam',
                                    '--ros-args', '-r', '__ns:=/shown'])
        try:
            _wait(lambda: {('frontend', '/shown'), ('loop_closure', '/shown')} <=
                  set(onlooker.get_node_names_and_namespaces()))
            _wait(lambda: set(displays) - {'image'} <= _shown_topics(onlooker))
            assert _shown_topics(onlooker) == set(displays) - {'image'}
            for topic in _shown_topics(onlooker):
                _check_quality(onlooker, topic, displays[topic]['Topic'])
        finally:
            process.kill()
            process.wait()


def test_rviz_starts_in_the_map_frame() -> None:
    manager = _rviz()['Visualization Manager']
    assert manager['Global Options']['Fixed Frame'] == 'map'
    assert all(display['Enabled'] == display['Value'] for display in _displays())


def _rviz() -> dict[str, Any]:
    return yaml.safe_load((CONFIG / 'aim_slam.rviz').read_text(encoding='utf-8'))


def _displays() -> Iterator[dict[str, Any]]:
    """Every display with a topic, also those in groups."""
    waiting = list(_rviz()['Visualization Manager']['Displays'])
    for display in waiting:
        waiting += display.get('Displays', [])
        if 'Topic' in display:
            yield display


def _shown_topics(node: Node) -> set[str]:
    """Relative names of what the nodes publish and RViz can show."""
    kinds = {'PointCloud2', 'PoseStamped', 'Odometry', 'Path', 'MarkerArray'}
    return {name.removeprefix('/shown/') for publisher in ('frontend', 'loop_closure')
            for name, types in node.get_publisher_names_and_types_by_node(publisher, '/shown')
            if types[0].rpartition('/')[2] in kinds}


def _check_quality(node: Node, topic: str, display: dict[str, Any]) -> None:
    """RViz asks for nothing that is not offered, and takes what is latched."""
    for offer in node.get_publishers_info_by_topic(f'/shown/{topic}'):
        latched = offer.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
        assert (display['Durability Policy'] == 'Transient Local') == latched, topic
        assert offer.qos_profile.reliability == ReliabilityPolicy.RELIABLE or \
            display['Reliability Policy'] == 'Best Effort', topic


def test_best_effort_images_arrive_with_the_shared_memory_profile(
        monkeypatch: pytest.MonkeyPatch) -> None:
    """Two processes, 640x480 at 30 Hz. The default transport delivers a sixth to a half of them,
    the profile all; 80 % tells the two apart even on a busy machine."""
    monkeypatch.setenv('FASTRTPS_DEFAULT_PROFILES_FILE', str(CONFIG / 'fastdds_shm.xml'))
    processes = multiprocessing.get_context('spawn')
    meeting, count = processes.Event(), processes.Value('i', 0)
    both = [processes.Process(target=_receive_images, args=(meeting, count)),
            processes.Process(target=_send_images, args=(meeting, 60))]
    for process in both:
        process.start()
    for process in both:
        process.join(TIMEOUT_S)
        process.kill()
    assert [process.exitcode for process in both] == [0, 0]
    assert count.value >= 0.8 * 60


def _receive_images(meeting: Any, count: Any) -> None:
    """Counts the images marked for it until their sender has gone."""
    def take(image: Image) -> None:
        meeting.set()
        count.value += image.header.frame_id == 'counted'

    with _node('receiver', '') as node:
        node.create_subscription(Image, 'traffic', take, _best_effort())
        while not (meeting.is_set() and node.count_publishers('traffic') == 0):
            rclpy.spin_once(node, executor=_executor(node), timeout_sec=0.1)


def _send_images(meeting: Any, number: int) -> None:
    """Unmarked images until the first arrives, then ``number`` marked ones."""
    with _node('sender', '') as node:
        publisher = node.create_publisher(Image, 'traffic', _best_effort())
        image = Image(height=480, width=640, encoding='rgb8', step=1920,
                      data=array('B', bytes(480 * 1920)))
        while not meeting.wait(1 / 30):
            publisher.publish(image)
        image.header.frame_id = 'counted'
        start_s = time.monotonic()
        for sent in range(1, number + 1):
            publisher.publish(image)
            time.sleep(max(0.0, start_s + sent / 30 - time.monotonic()))


def _executor(node: Node) -> Any:
    """One for each node: the global one belongs to the default context."""
    if not node.executor:
        executor = rclpy.executors.SingleThreadedExecutor(context=node.context)
        executor.add_node(node)
    return node.executor


def _best_effort() -> QoSProfile:
    return QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)


def _wait(condition: Callable[[], bool]) -> None:
    end_s = time.monotonic() + TIMEOUT_S
    while not condition():
        assert time.monotonic() < end_s, 'timed out'
        time.sleep(0.05)
