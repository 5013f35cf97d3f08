"""The frontend as a process over DDS: whatever comes in, it answers, says why, and goes on."""

from __future__ import annotations

import signal
import time
from pathlib import Path
from typing import Any, Callable, Iterator

import clip as clips
import numpy as np
import pytest
from clip import Clip
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile, ReliabilityPolicy
from ros_peer import Peer, Process, wait_for
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2
from std_srvs.srv import Trigger
from tf_stand_in import STAND_IN

from aim_slam_ros.types import FrameReport, TrackingStatus
from msg_adapters import images
from msg_adapters.diagnostics import values_of
from msg_adapters.frames import frame_report
from msg_adapters.stamps import stamp_msg, stamp_ns

MODULE = 'aim_slam_ros.cli.frontend'
SMALL = ('-p', f'camera.width:={clips.WIDTH}', '-p', 'publish_tf:=false')
START_NS = 10 ** 9      # a stamp of 0 is no stamp
BEST_EFFORT = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
Break = Callable[[Image], Any]


class Driver:
    """Feeds one frontend and reads its answers, one for each image."""

    def __init__(self, peer: Peer, process: Process, namespace: str = '/') -> None:
        self.peer, self.process, self.namespace = peer, process, namespace
        self.rows = peer.hear(PointCloud2, f'{namespace}frame')
        self.poses = peer.hear(PoseStamped, f'{namespace}pose')
        self.image = peer.publisher(Image, f'{namespace}image')
        wait_for(lambda: peer.node.count_publishers(f'{namespace}frame'), 'the frontend')
        self._next_ns = START_NS

    def reset(self) -> None:
        """A new map; stamps go on."""
        assert self.peer.call(Trigger, f'{self.namespace}frontend/reset').success

    def stamp(self) -> int:
        self._next_ns += 10 ** 8
        return self._next_ns

    def reports(self) -> list[FrameReport]:
        return [frame_report(row) for row in list(self.rows)]

    def answer(self, message: Image) -> FrameReport:
        """Publish it and wait for what the frontend says of it."""
        stamp = stamp_ns(message.header.stamp)
        before = len(self.rows)
        self.image.publish(message)
        wait_for(lambda: any(r.result.stamp_ns == stamp for r in self.reports()[before:]),
                 f'an answer to the image of {stamp} ns')
        return next(r for r in self.reports()[before:] if r.result.stamp_ns == stamp)

    def send(self, rgb: np.ndarray) -> FrameReport:
        return self.answer(images.image_msg(rgb, self.stamp(), 'camera_optical_frame'))


@pytest.fixture(scope='module')
def driver(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Driver]:
    """One frontend for all bad input: what one case breaks the next would notice."""
    log = tmp_path_factory.mktemp('frontend') / 'frontend.log'
    arguments = ('--ros-args', *SMALL, '-p', 'camera.use_calibration:=true')
    with Peer() as peer, Process(log, MODULE, *arguments) as process:
        yield Driver(peer, process)
        assert process.alive, process.output
        assert 'Traceback' not in process.output, process.output


def _image(clip: Clip, driver: Driver, index: int = 0) -> Image:
    return images.image_msg(clip.images[index], driver.stamp(), 'camera_optical_frame')


def _set(**values: Any) -> Break:
    def change(message: Image) -> None:
        for name, value in values.items():
            setattr(message, name, value)
    return change


@pytest.mark.parametrize('spoil, words', [
    (_set(encoding='rgb9'), 'rgb9'),
    (_set(step=17), 'step'),
    (_set(data=b'\1\2\3'), 'data'),
    (_set(height=0, width=0, data=b'', step=0), 'zero|empty|0x0'),
    (_set(data=bytes(320 * 240 * 3)), 'black'),
], ids=['unknown encoding', 'step', 'length', 'no size', 'black'])
def test_a_useless_image_is_skipped_with_its_reason(driver: Driver, clip: Clip, spoil: Break,
                                                    words: str) -> None:
    driver.reset()
    message = _image(clip, driver)
    spoil(message)
    said = len(driver.process.output)
    assert driver.answer(message).result.status is TrackingStatus.SKIPPED
    assert driver.send(clip.images[1]).result.status is TrackingStatus.INITIALISING, 'it goes on'
    wait_for(lambda: any(word in driver.process.output[said:] for word in words.split('|')),
             f'{words} in the log')


def test_every_encoding_is_taken(driver: Driver, clip: Clip) -> None:
    """That colours come out right is tested in test_images; here they cross DDS."""
    driver.reset()
    rgb = clip.images[0]
    grey = rgb.mean(2).astype(np.uint8)
    alpha = np.dstack([rgb, np.full_like(grey, 255)])
    wide = (grey.astype(np.uint16) << 8)
    yuv = np.dstack([np.full_like(grey, 128), grey])
    for encoding, pixels in {
            'mono8': grey, 'rgb8': rgb, 'bgr8': rgb[..., ::-1], 'rgba8': alpha,
            'bgra8': alpha, 'mono16': wide, 'bayer_rggb8': grey, 'bayer_grbg8': grey,
            'bayer_gbrg8': grey, 'bayer_bggr8': grey, 'yuv422': yuv,
            'yuv422_yuy2': yuv[..., ::-1]}.items():
        data = np.ascontiguousarray(pixels)
        message = Image(encoding=encoding, height=data.shape[0], width=data.shape[1],
                        step=data.strides[0], data=data.tobytes())
        message.header.stamp = stamp_msg(driver.stamp())
        assert driver.answer(message).result.status is TrackingStatus.INITIALISING, encoding


def test_another_size_in_mid_stream_is_skipped(driver: Driver, clip: Clip) -> None:
    driver.reset()
    driver.send(clip.images[0])
    assert driver.send(clip.images[1][:200]).result.status is TrackingStatus.SKIPPED
    assert driver.send(clip.images[1]).result.status is TrackingStatus.INITIALISING
    driver.reset()
    assert driver.send(clip.images[1][:200]).result.status is TrackingStatus.INITIALISING


def test_a_duplicate_and_a_late_image_are_skipped(driver: Driver, clip: Clip) -> None:
    driver.reset()
    message = _image(clip, driver)
    assert driver.answer(message).result.status is TrackingStatus.INITIALISING
    assert driver.answer(message).result.status is TrackingStatus.SKIPPED
    message.header.stamp = stamp_msg(stamp_ns(message.header.stamp) - 10 ** 7)
    assert driver.answer(message).result.status is TrackingStatus.SKIPPED


def test_an_image_without_a_stamp_in_mid_stream_is_skipped(driver: Driver, clip: Clip) -> None:
    driver.reset()
    first = driver.send(clip.images[0])
    message = _image(clip, driver, 1)
    message.header.stamp = stamp_msg(0)
    assert driver.answer(message).result.status is TrackingStatus.SKIPPED
    broken = _image(clip, driver, 1)
    broken.header.stamp, broken.encoding = stamp_msg(START_NS // 10), 'rgb9'
    assert driver.answer(broken).result.status is TrackingStatus.SKIPPED
    assert driver.send(clip.images[2]).session_id == first.session_id, 'no new map begins'


def test_a_bag_played_again_begins_a_new_map_and_it_is_said_once(driver: Driver,
                                                                 clip: Clip) -> None:
    driver.reset()
    said = driver.process.output.count('time went back')
    first = [driver.send(clip.images[k]) for k in range(12)]
    assert first[-1].result.stamp_ns > START_NS + 10 ** 9
    driver._next_ns = START_NS
    again = [driver.send(clip.images[k]) for k in range(3)]
    assert len({r.session_id for r in first}) == len({r.session_id for r in again}) == 1
    assert first[0].session_id != again[0].session_id, 'keyframe ids begin again'
    assert {r.result.status for r in again} == {TrackingStatus.INITIALISING}
    assert driver.process.output.count('time went back') == said + 1


@pytest.mark.parametrize('spoil, words', [
    ([float('nan')] * 9, 'not finite'),
    ([-1.0, 0, 160, 0, -1.0, 120, 0, 0, 1], 'focal'),
])
def test_an_unusable_camera_info_is_said_and_not_used(driver: Driver, clip: Clip,
                                                      spoil: list[float], words: str) -> None:
    driver.reset()
    info = images.camera_info_msg(clip.K, *clips.SIZE, driver.stamp(), 'camera_optical_frame')
    info.k = [float(value) for value in spoil]
    publisher = driver.peer.publisher(CameraInfo, 'camera_info')
    said = len(driver.process.output)
    _publish_until(publisher, info, lambda: words in driver.process.output[said:].lower(), words)
    driver.peer.node.destroy_publisher(publisher)
    assert driver.send(clip.images[0]).result.status is TrackingStatus.INITIALISING


def _publish_until(publisher: Any, info: CameraInfo, condition: Callable[[], bool],
                   words: str) -> None:
    """As a camera does: camera_info is taken best effort, and a message may be lost."""
    def said() -> bool:
        publisher.publish(info)
        time.sleep(0.1)
        return condition()
    wait_for(said, f'{words} in the log')


def test_a_map_is_made_and_told(driver: Driver, clip: Clip) -> None:
    """After all that: poses of the images' stamps, odometry, points, keyframes, diagnostics."""
    odometry = driver.peer.hear(Odometry, 'odometry')
    points = driver.peer.hear(PointCloud2, 'points')
    tables = driver.peer.hear(PointCloud2, 'keyframe')
    told = driver.peer.hear(DiagnosticArray, '/diagnostics')
    driver.reset()
    driver.poses.clear()
    sent = [driver.send(image).result.stamp_ns for image in clip.images]
    wait_for(lambda: len(driver.poses) > 0.9 * len(clip) and points and tables, 'poses and a map')
    stamps = [stamp_ns(pose.header.stamp) for pose in driver.poses]
    assert set(stamps) <= set(sent) and stamps == sorted(stamps)
    wait_for(lambda: len(odometry) == len(driver.poses), 'odometry for every pose')
    for pose, odom in zip(driver.poses, odometry):
        assert pose.header == odom.header and pose.pose == odom.pose.pose
    assert {p.header.frame_id for p in driver.poses} == {'odom'} == {
        p.header.frame_id for p in points}
    assert {o.child_frame_id for o in odometry} == {'camera_optical_frame'}
    assert {stamp_ns(t.header.stamp) for t in tables} <= set(sent)
    # The model, in a thread of its own, may still make a keyframe of one of the last images.
    told.clear()
    wait_for(lambda: told and _values(told[-1])['model_busy'] == 'false'
             and int(_values(told[-1])['keyframes']) == _different(tables), 'an idle model')
    heard = len(tables)     # some more than once: by then they were known better
    keyframes = _different(tables)
    answer = driver.peer.call(Trigger, 'frontend/resend_keyframes')
    assert answer.success and answer.message == f'{keyframes} keyframes follow'
    wait_for(lambda: len(tables) == heard + keyframes, 'all keyframes once more')
    told.clear()
    wait_for(lambda: told, 'diagnostics')
    values = _values(told[-1])
    assert values['state'] == 'tracked' and int(values['keyframes']) == keyframes
    assert float(values['memory_mb']) > 50.0


def test_a_failing_model_takes_no_pose_from_an_image(tmp_path: Path, clip: Clip) -> None:
    """It is asked about every image; each is followed, and what fails is said, not each time."""
    with Peer() as peer, Process(
            tmp_path / 'log', 'failing_frontend', '--ros-args', '-r', '__ns:=/failing', *SMALL,
            '-p', 'model.infer:=every_image') as process:
        driver = Driver(peer, process, '/failing/')

        def errors(which: str) -> int:
            own = [m for m in told if m.status[0].name.startswith('/failing')]
            return int(_values(own[-1], '/failing/')[which]) if own else -1
        told = peer.hear(DiagnosticArray, '/diagnostics')
        index = 0
        while not driver.poses and index < 40:
            driver.send(clip.images[index])
            index += 1
        process.signal(signal.SIGUSR1)
        process.says('from now on the model fails')
        after = [driver.send(image).result for image in clip.images[index:index + 10]]
        assert [r.status for r in after] == [TrackingStatus.TRACKED] * 10
        wait_for(lambda: errors('model_errors') >= 5, 'the count')
        assert 'the model failed: RuntimeError: another program took the memory' in process.output
        assert process.output.count('the model failed') <= 2
        assert process.alive and errors('errors') == 0
        driver.reset()
        first = [driver.send(image).result for image in clip.images[:12]]
        assert {r.status for r in first} == {TrackingStatus.INITIALISING}, 'each is answered'


def _values(message: DiagnosticArray, namespace: str = '/') -> dict[str, str]:
    return values_of(message, f'{namespace}frontend: tracking')


def _different(tables: list[PointCloud2]) -> int:
    return len({stamp_ns(t.header.stamp) for t in tables})


def test_ctrl_c_twice_ends_it_quickly_and_quietly(driver: Driver, tmp_path: Path,
                                                  clip: Clip) -> None:
    with Process(tmp_path / 'log', MODULE, '--ros-args', '-r', 'image:=other', *SMALL) as process:
        process.says('waiting for images on /other')
        started = time.monotonic()
        process.signal(signal.SIGINT)
        time.sleep(0.1)
        process.signal(signal.SIGINT)
        assert process.ended(5.0) == 0
        assert time.monotonic() - started < 3.0, 'promised to the user'
        assert 'Traceback' not in process.output, process.output


def test_a_topic_that_never_comes_is_said_with_those_that_exist(tmp_path: Path) -> None:
    with Peer() as peer, Process(
            tmp_path / 'log', MODULE, '--ros-args', '-r', 'image:=/nothing', *SMALL,
            '-p', 'image_timeout_s:=1.0') as process:
        peer.node.create_publisher(Image, '/camera/image_raw', 1)
        process.says('remap with --ros-args -r image:=/camera/image_raw')
        assert 'nobody publishes /nothing' in process.output


def test_a_topic_of_the_other_transport_is_said(tmp_path: Path) -> None:
    with Peer() as peer, Process(
            tmp_path / 'log', MODULE, '--ros-args', '-r', 'image/compressed:=/nothing', *SMALL,
            '-p', 'image_timeout_s:=1.0', '-p', 'image_transport:=compressed') as process:
        peer.node.create_publisher(Image, '/camera/image_raw', 1)
        process.says('take it with --ros-args -p image_transport:=raw -r image:=/camera/image_raw')


@pytest.mark.parametrize('reliability', ['auto', 'reliable'])
def test_a_best_effort_camera(tmp_path: Path, clip: Clip, reliability: str) -> None:
    """auto takes it as it is; reliable can't, and says which parameter to change.

    Simulated time that stands still changes nothing.
    """
    with Peer() as peer, Process(
            tmp_path / 'log', MODULE, '--ros-args', '-r', '__ns:=/best', *SMALL,
            '-p', 'use_sim_time:=true',
            '-p', f'image_reliability:={reliability}') as process:
        camera = peer.node.create_publisher(Image, '/best/image', BEST_EFFORT)
        rows = peer.hear(PointCloud2, '/best/frame')
        if reliability == 'reliable':
            process.says('set the parameter image_reliability to auto or best_effort')
            return
        process.says('is taken so')
        wait_for(camera.get_subscription_count, 'the new subscription')
        for k in range(100):
            camera.publish(images.image_msg(clip.images[0], START_NS + k, 'c'))
            if rows:
                break
            time.sleep(0.05)
        assert rows


def test_a_calibration_that_does_not_come_is_said(tmp_path: Path, clip: Clip) -> None:
    """And one of a camera that is best effort, as its images are, is taken."""
    with Peer() as peer, Process(
            tmp_path / 'log', MODULE, '--ros-args', '-r', '__ns:=/lacking', *SMALL,
            '-p', 'camera.use_calibration:=true') as process:
        driver = Driver(peer, process, '/lacking/')

        def said_after_an_image() -> bool:
            driver.send(clip.images[0])
            return 'nothing comes on /lacking/camera_info' in process.output
        wait_for(said_after_an_image, 'a word on the missing calibration')
        info = images.camera_info_msg(clip.K, *clips.SIZE, START_NS, 'c', [0.1, 0, 0, 0, 0])
        publisher = peer.node.create_publisher(CameraInfo, '/lacking/camera_info', BEST_EFFORT)
        wait_for(publisher.get_subscription_count, 'the subscription')
        _publish_until(publisher, info, lambda: 'the images are distorted' in process.output,
                       'distorted')


TF = STAND_IN + """
import os
from geometry_msgs.msg import TransformStamped


class TransformListener:
    def __init__(self, buffer, node):
        print('listens', flush=True)


class Buffer(Buffer):
    def lookup_transform(self, target_frame, source_frame, time):
        if os.path.exists('known'):
            found = TransformStamped()
            found.transform.rotation.w = 1.0
            found.transform.translation.z = -0.5
            self.known[target_frame, source_frame] = found
        return super().lookup_transform(target_frame, source_frame, time)
"""


def test_odometry_of_a_robot_waits_until_tf_knows_the_camera(tmp_path: Path, clip: Clip) -> None:
    """A buffer that hears of the camera in odom would forget where on the robot it is."""
    (tmp_path / 'tf2_ros.py').write_text(TF)
    with Peer() as peer, Process(
            tmp_path / 'log', MODULE, '--ros-args', '-r', '__ns:=/robot',
            '-p', f'camera.width:={clips.WIDTH}', '-p', 'base_frame:=base_link') as process:
        driver = Driver(peer, process, '/robot/')
        odometry = peer.hear(Odometry, '/robot/odometry')
        process.says('listens')      # from the beginning
        sent = iter(clip.images)
        while len(driver.poses) < 5:
            driver.send(next(sent))
        process.says('TF does not know camera_optical_frame in base_link')
        assert 'sent' not in process.output and not odometry
        (tmp_path / 'known').touch()
        driver.send(next(sent))
        process.says(' odom base_link')
        wait_for(lambda: odometry, 'odometry of the robot')
        assert odometry[0].child_frame_id == 'base_link'
        assert ' odom camera' not in process.output


def test_two_frontends_side_by_side(tmp_path: Path, clip: Clip) -> None:
    """Two namespaces; parameters from YAML and the command line; a remapped, compressed image
    topic; sim time. Neither hears what the other is told."""
    parameters = tmp_path / 'left.yaml'
    parameters.write_text(f'/**:\n  ros__parameters:\n    camera.width: {clips.WIDTH}\n'
                          '    odom_frame: left_odom\n    publish_tf: false\n', encoding='utf-8')
    left = ('--ros-args', '-r', '__ns:=/left', '--params-file', str(parameters))
    right = ('--ros-args', '-r', '__ns:=/right', '-r', 'image/compressed:=/camera/jpeg', *SMALL,
             '-p', 'image_transport:=compressed', '-p', 'use_sim_time:=true',
             '-p', 'odom_frame:=right_odom')
    with Peer() as peer, \
            Process(tmp_path / 'left.log', MODULE, *left), \
            Process(tmp_path / 'right.log', MODULE, *right):
        told = peer.hear(DiagnosticArray, '/diagnostics')
        rows = {side: peer.hear(PointCloud2, f'/{side}/frame') for side in ('left', 'right')}
        for side in rows:
            wait_for(lambda: peer.node.count_publishers(f'/{side}/frame'), side)
        cameras = {'left': peer.publisher(Image, '/left/image'),
                   'right': peer.publisher(CompressedImage, '/camera/jpeg')}
        clock = peer.publisher(Clock, '/clock', listeners=1)
        for k in range(6):
            cameras['left'].publish(images.image_msg(clip.images[k], START_NS + k, 'l'))
            wait_for(lambda: len(rows['left']) == k + 1, 'the left answer')
        for k in range(4):
            cameras['right'].publish(images.compressed_msg(clip.images[k], START_NS + k, 'r'))
            wait_for(lambda: len(rows['right']) == k + 1, 'the right answer')
        assert len(rows['left']) == 6
        for side in rows:
            assert {row.header.frame_id for row in rows[side]} == {f'{side}_odom'}
            assert {frame_report(row).result.status for row in rows[side]} \
                == {TrackingStatus.INITIALISING}
        _tick_until(clock, lambda: _stamp_of(told, '/right/frontend') > 0)
        assert 4_999 <= _stamp_of(told, '/right/frontend') // 10 ** 9 <= 6_000, 'sim time'
        wait_for(lambda: _stamp_of(told, '/left/frontend') // 10 ** 9 > 10 ** 9, 'the wall clock')


def _stamp_of(told: list[DiagnosticArray], node: str) -> int:
    """The newest diagnostics of a node, ns; 0 before."""
    return next((stamp_ns(array.header.stamp) for array in reversed(told)
                 if array.status[0].name.startswith(node)), 0)


def _tick_until(clock: Any, condition: Callable[[], bool]) -> None:
    """Simulated time from 5000 s on, ten times as fast as ours."""
    for k in range(1000):
        clock.publish(Clock(clock=stamp_msg(5_000 * 10 ** 9 + k * 10 ** 9 // 10)))
        if condition():
            return
        time.sleep(0.01)
    raise AssertionError('nothing came under simulated time')


def test_wrong_parameters_are_refused_in_one_line(tmp_path: Path) -> None:
    with Process(tmp_path / 'log', MODULE, '--ros-args', '-p', 'camera.width:=500') as process:
        assert process.ended() == 2
        (line,) = process.output.strip().splitlines()
        assert 'camera.width' in line and 'multiple of 14' in line
