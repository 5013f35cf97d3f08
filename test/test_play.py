"""The bag player over real DDS: to another process and from one."""

from __future__ import annotations

import signal
import threading
import time
from pathlib import Path
from typing import Any, Iterator

import bag_making as making
import numpy as np
import pytest
import rclpy
from bag_making import FIRST_NS, ROS1, ROS2, STEP_NS, picture
from geometry_msgs.msg import TransformStamped
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from ros_peer import Peer, Process, wait_for
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image

from aim_slam_ros.cli.play import main, split_ros_arguments
from aim_slam_ros.datasets import DatasetError
from aim_slam_ros.nodes.replay.player import Player, PlayError, PlayOptions, Published
from msg_adapters.encodings import rgb_from_image
from msg_adapters.stamps import stamp_ns

PLAY = 'aim_slam_ros.cli.play'
COUNT = 15
STAMPS = [FIRST_NS + i * STEP_NS for i in range(COUNT)]
LENGTH_S = (COUNT - 1) * STEP_NS / 1e9
K = np.array([[50.0, 0.0, 31.5], [0.0, 51.0, 23.5], [0.0, 0.0, 1.0]])
# Linux on two busy cores lets a thread wait for so long now and then; alone it is below 5 ms.
LATE_S = 0.25


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """Images at 10 Hz, and camera_info and a transform, once."""
    return making.write_ros2(tmp_path / 'bag', others(ROS2) + making.images(COUNT))


@pytest.fixture
def node() -> Iterator[Node]:
    context = Context()
    rclpy.init(context=context)
    node = Node('player', context=context)
    yield node
    node.destroy_node()
    context.try_shutdown()


def others(store: Any) -> list[making.Record]:
    first_ns = FIRST_NS + 5_000_000     # with the first image
    info = making.camera_info(K, (), FIRST_NS, store)
    return [('/camera_info', first_ns, info), ('/where', first_ns, making.transform(
        (1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0), FIRST_NS, store))]


def stamps_of(heard: list[Any]) -> list[int]:
    return [stamp_ns(message.header.stamp) for message in heard]


# Another process plays.

def test_everything_arrives_as_it_was_recorded(bag: Path, tmp_path: Path) -> None:
    with Peer() as peer, Process(tmp_path / 'play.log', PLAY, str(bag)) as player:
        infos = peer.hear(CameraInfo, '/camera_info')
        transforms = peer.hear(TransformStamped, '/where')
        images = peer.hear(Image, '/image')
        assert player.ended() == 0
        wait_for(lambda: len(images) >= COUNT, 'the images')
        assert stamps_of(images) == STAMPS
        for i, image in enumerate(images):
            np.testing.assert_array_equal(rgb_from_image(image), picture(i))
        # It waits for the images' subscriber; others may be found a moment later.
        assert stamps_of(infos) in ([], [FIRST_NS]) and stamps_of(transforms) in ([], [FIRST_NS])
    assert f'{COUNT + 2} messages, {COUNT} of them images' in player.output
    assert f'{COUNT}/{COUNT} images' in player.output


def test_a_ros1_bag_is_played_as_ros2_messages(tmp_path: Path) -> None:
    path = making.write_ros1(tmp_path / 'old.bag', making.images(5, store=ROS1))
    with Peer() as peer, Process(tmp_path / 'play.log', PLAY, str(path)) as player:
        images = peer.hear(Image, '/image')
        assert player.ended() == 0
        wait_for(lambda: len(images) >= 5, 'the images')
        assert stamps_of(images) == STAMPS[:5] and images[0].header.frame_id == 'lens'
        np.testing.assert_array_equal(rgb_from_image(images[4]), picture(4))


def test_names_can_be_remapped_and_put_into_a_namespace(bag: Path, tmp_path: Path) -> None:
    with Peer() as peer, Process(
            tmp_path / 'play.log', PLAY, str(bag), '--rate', '10', '--ros-args', '-r',
            'image:=camera/image_raw', '-r', '__ns:=/robot', '--', '--clock') as player:
        images = peer.hear(Image, '/robot/camera/image_raw')
        clock = peer.hear(Clock, '/clock')
        assert player.ended() == 0
        wait_for(lambda: len(images) >= COUNT, 'the images')
        wait_for(lambda: clock, 'the clock')


def test_it_begins_again_until_it_is_interrupted_twice(bag: Path, tmp_path: Path) -> None:
    with Peer() as peer, Process(tmp_path / 'play.log', PLAY, str(bag), '--loop', '--rate', '5',
                                 '--topics', 'image') as player:
        images = peer.hear(Image, '/image')
        wait_for(lambda: len(images) > 2 * COUNT, 'a third round')
        told_s = time.monotonic()
        player.signal(signal.SIGINT)
        player.signal(signal.SIGINT)
        assert player.ended() == 130
        assert time.monotonic() - told_s < 3.0
        # Stamps go back where it begins again, and none is missing.
        assert stamps_of(images)[:2 * COUNT + 1] == STAMPS + STAMPS + STAMPS[:1]
    assert 'interrupted' in player.output and 'Traceback' not in player.output


def test_nobody_listening_is_said_with_what_is_listened_to(bag: Path, tmp_path: Path) -> None:
    with Peer() as peer:
        peer.hear(Image, '/camera/image')
        with Process(tmp_path / 'play.log', PLAY, str(bag), '--wait', '3') as player:
            assert player.ended() == 2
        assert f'/camera/image (by /{peer.node.get_name()})' in player.output
    assert 'nobody has subscribed to /image within 3 s' in player.output
    assert 'remap' in player.output and 'Traceback' not in player.output


def test_a_subscriber_that_wants_latched_images_is_told_apart(bag: Path, node: Node) -> None:
    quality = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    with Peer() as peer:
        peer.hear(Image, '/image', quality)
        player = Player(node, bag)
        # A subscription may be known a moment before its node's name is.
        wait_for(lambda: [info.node_name for info in node.get_subscriptions_info_by_topic(
            '/image')] == [peer.node.get_name()], 'discovery')
        with pytest.raises(PlayError, match=f'{peer.node.get_name()}.*QoS that does not'):
            player.wait_for_subscriber(0.1)


@pytest.mark.parametrize('arguments, expected', [
    (['--rate', '0'], 'above 0'), (['--rate', 'nan'], 'above 0'), (['--rate', 'inf'], 'above 0'),
    (['--start-offset', '-1'], 'from 0 on'), (['--wait', 'x'], 'from 0 on'),
    (['--speed', '2'], '--speed')])
def test_a_wrong_option_is_refused(bag: Path, capsys: pytest.CaptureFixture[str],
                                   arguments: list[str], expected: str) -> None:
    assert main([str(bag), *arguments]) == 2
    assert expected in capsys.readouterr().err


@pytest.mark.parametrize('arguments, expected', [
    (['nothing.mcap'], 'does not exist'), (['BAG', '--topics', '/up'], 'has no topic up'),
    (['BAG', '--ros-args', '-r', 'nonsense'], 'the ROS arguments cannot be used')])
def test_what_cannot_be_played_is_refused(bag: Path, capsys: pytest.CaptureFixture[str],
                                          arguments: list[str], expected: str) -> None:
    assert main([str(bag) if argument == 'BAG' else argument for argument in arguments]) == 2
    assert expected in capsys.readouterr().err


def test_arguments_for_ros_are_told_from_the_own() -> None:
    given = ['bag', '--ros-args', '-r', 'a:=b', '--', '--rate', '2', '--ros-args', '-p', 'x:=1']
    assert split_ros_arguments(given) == (
        ['bag', '--rate', '2'],
        ['--ros-args', '-r', 'a:=b', '--', '--ros-args', '-p', 'x:=1'])


# The library, in the test's own process.

def test_messages_leave_in_order_when_they_are_due(bag: Path, node: Node) -> None:
    published: list[Published] = []
    player = Player(node, bag, PlayOptions(rate=2.0))
    assert (player.images, player.messages) == (COUNT, COUNT + 2)
    assert player.length_s == pytest.approx(LENGTH_S / 2)
    began_s = time.monotonic()
    played = player.play(published.append)
    took_s = time.monotonic() - began_s
    player.close()
    assert LENGTH_S / 2 <= took_s < LENGTH_S / 2 + LATE_S
    assert (played.images, played.messages) == (COUNT, COUNT + 2)
    images = [p for p in published if p.is_image]
    assert [p.stamp_ns for p in images] == STAMPS and images[0].topic == '/image'
    # Never early; late by what the system lets a thread wait.
    for one in images:
        due_ns = (one.stamp_ns - FIRST_NS) / 2
        since_ns = one.monotonic_ns - images[0].monotonic_ns
        assert abs(since_ns - due_ns) < LATE_S * 1e9 and 0 <= one.late_ns < LATE_S * 1e9
    assert played.late_max_ns == max(p.late_ns for p in published)


def test_a_part_is_played_and_its_images_are_counted_before(bag: Path, node: Node) -> None:
    published: list[Published] = []
    # From the middle between images 2 and 3 to that between 7 and 8.
    player = Player(node, bag, PlayOptions(rate=20.0, start_offset_s=0.25, duration_s=0.5))
    assert (player.images, player.messages) == (5, 5)
    player.play(published.append)
    assert [p.stamp_ns for p in published] == STAMPS[3:8]
    with pytest.raises(PlayError, match='is 1.4 s long'):
        Player(node, bag, PlayOptions(start_offset_s=2.0))
    with pytest.raises(PlayError, match='no message in this span'):
        Player(node, bag, PlayOptions(start_offset_s=0.22, duration_s=0.05))


def test_the_clock_runs_with_the_bag(bag: Path, node: Node) -> None:
    rate, clock_hz = 2.0, 100.0
    with Peer() as peer:
        clock = peer.hear(Clock, '/clock')
        player = Player(node, bag, PlayOptions(rate=rate, clock_hz=clock_hz))
        wait_for(lambda: node.count_subscribers('/clock'), 'discovery')
        player.play()
        last_ns = STAMPS[-1] + 5_000_000        # recorded 5 ms after its stamp
        wait_for(lambda: clock and stamp_ns(clock[-1].clock) > last_ns - 10**8, 'the last tick')
    times = [stamp_ns(message.clock) for message in clock]
    assert times == sorted(times)
    assert times[0] >= FIRST_NS and times[-1] <= last_ns + LATE_S * rate * 1e9
    # Ticks of a pause of the process are not made up for.
    assert 0.5 * clock_hz * LENGTH_S / rate < len(times) <= clock_hz * LENGTH_S / rate + 2


def test_a_latched_topic_reaches_who_comes_late(tmp_path: Path, node: Node) -> None:
    records = [('/tf_static', log_ns, message) for _, log_ns, message in others(ROS2)[1:]]
    bag = making.write_ros2(tmp_path / 'bag', records + making.images(2))
    player = Player(node, bag)
    player.play()
    with Peer() as peer:
        quality = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        heard = peer.hear(TransformStamped, '/tf_static', quality)
        wait_for(lambda: heard, 'the latched message')


def test_stopping_ends_it_at_once(bag: Path, node: Node) -> None:
    stop = threading.Event()
    player = Player(node, bag, PlayOptions(rate=0.01))
    threading.Timer(0.2, stop.set).start()
    began_s = time.monotonic()
    played = player.play(stop=stop)
    assert time.monotonic() - began_s < 0.2 + LATE_S and played.images == 1
    player.close()


def test_what_cannot_be_published_is_left_out_with_the_reason(tmp_path: Path, node: Node) -> None:
    string = making.make(ROS2, 'std_msgs/msg/String', data='x')
    tf = making.make(ROS2, 'tf2_msgs/msg/TFMessage', transforms=[])
    bag = making.write_ros2(tmp_path / 'bag', [('/a', 1, string), ('/tf', 2, tf)])
    player = Player(node, bag)
    assert player.images == 0 and player.image_topics == []
    try:
        import tf2_msgs  # noqa: F401
    except ModuleNotFoundError:
        assert player.left_out == {'/tf': 'its type tf2_msgs/msg/TFMessage is not installed'}
        with pytest.raises(PlayError, match='nothing that can be played.*install'):
            Player(node, bag, PlayOptions(topics=('/tf',)))


def test_a_bag_that_breaks_off_is_played_until_there(tmp_path: Path, node: Node) -> None:
    """Its index is whole, and a chunk in the middle is not."""
    folder = making.write_ros2(tmp_path / 'bag', making.images(60, size=(96, 128)))
    path = folder / 'bag.mcap'
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle:middle + 60_000] = b'\xff' * 60_000      # more than a message, so its size too
    path.write_bytes(data)
    published: list[Published] = []
    player = Player(node, path, PlayOptions(rate=100.0))
    with pytest.raises(DatasetError, match='repair'):
        player.play(published.append)
    # Chunks hold 1 MB, which are 28 messages.
    assert [p.stamp_ns for p in published] == [FIRST_NS + i * STEP_NS for i in range(29)]
