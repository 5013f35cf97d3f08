"""Frontend and loop closure as two processes over DDS, fed with rendered images."""

from __future__ import annotations

import signal
import time
from pathlib import Path
from typing import Any

import clip as clips
import numpy as np
import torch
from clip import Clip
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMessage
from rclpy.qos import DurabilityPolicy, QoSProfile
from room_walk import ate
from ros_peer import Peer, Process, wait_for
from sensor_msgs.msg import Image, PointCloud2

from aim_slam_ros.datasets import load_sequence
from aim_slam_ros.datasets.rendered import render
from aim_slam_ros.geometry import sim3
from aim_slam_ros.types import TrackingStatus
from msg_adapters import images
from msg_adapters.clouds import cloud_from_msg
from msg_adapters.diagnostics import values_of
from msg_adapters.frames import frame_report
from msg_adapters.keyframes import keyframe_event
from msg_adapters.poses import T_ZUP_OPTICAL, matrix
from msg_adapters.stamps import stamp_ns

FRONTEND = 'aim_slam_ros.cli.frontend'
LOOP_CLOSURE = 'aim_slam_ros.cli.loop_closure'
SMALL = ('--ros-args', '-p', f'camera.width:={clips.WIDTH}', '-p', 'publish_tf:=false')
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
CAMERA = 'left_camera_optical_frame'
START_NS = 10 ** 9
STEP_NS = 10 ** 8       # of the clip's images


class Robot:
    """A camera, and what it hears of where it is."""

    def __init__(self, peer: Peer, frontends: int = 1) -> None:
        """frontends: so many are known; one that was killed is, until its lease ends (20 s)."""
        self.rows = peer.hear(PointCloud2, 'frame')
        self.poses = peer.hear(PoseStamped, 'pose')
        self.odometry = peer.hear(Odometry, 'odometry')
        self.points = peer.hear(PointCloud2, 'points')
        self.tables = peer.hear(PointCloud2, 'keyframe')
        self.clouds = peer.hear(PointCloud2, 'keyframe_cloud')
        self.corrected = peer.hear(PoseStamped, 'corrected_pose')
        self.path = peer.hear(PathMessage, 'path', LATCHED)
        self.map = peer.hear(PointCloud2, 'map', LATCHED)
        self._diagnostics = peer.hear(DiagnosticArray, '/diagnostics')
        self.camera = peer.publisher(Image, 'image', listeners=frontends)
        wait_for(lambda: peer.node.count_publishers('frame') >= frontends, 'the frontend')

    def show(self, image: np.ndarray, stamp: int) -> None:
        """One image; returns when there is an answer."""
        before = len(self.rows)
        self.camera.publish(images.image_msg(image, stamp, CAMERA))
        wait_for(lambda: any(stamp_ns(row.header.stamp) == stamp for row in self.rows[before:]),
                 'an answer')

    def walk(self, clip: Clip, indices: range, later_ns: int = 0) -> None:
        for index in indices:
            self.show(clip.images[index], START_NS + later_ns + clip.stamps_ns[index])

    def loop_closure_says(self, name: str) -> str:
        for array in reversed(self._diagnostics):
            values = values_of(array, '/loop_closure: loop closure')
            if values:
                return values[name]
        return ''

    def frontend_has(self) -> int:
        """Keyframes, by its own count."""
        ids = {keyframe_event(t, c).event.keyframe_id for t, c in self.keyframes()}
        return len(ids)

    def keyframes(self) -> list[tuple[PointCloud2, PointCloud2]]:
        clouds = {stamp_ns(cloud.header.stamp): cloud for cloud in self.clouds}
        return [(table, clouds[stamp_ns(table.header.stamp)]) for table in self.tables
                if stamp_ns(table.header.stamp) in clouds]


def _stamps(messages: list[Any]) -> list[int]:
    return [stamp_ns(message.header.stamp) for message in messages]


def test_two_processes(tmp_path: Path, clip: Clip) -> None:
    """The whole surface, then deaths of either side."""
    frontend = Process(tmp_path / 'frontend.log', FRONTEND, *SMALL)
    first = Process(tmp_path / 'loop_closure.log', LOOP_CLOSURE, *SMALL)
    with Peer() as peer, frontend, first:
        robot = Robot(peer)
        wait_for(lambda: peer.node.count_publishers('corrected_pose'), 'loop closure')
        first.says('asked the frontend')    # the two have found each other
        robot.walk(clip, range(30))
        _check_surface(robot, clip)
        _check_keyframes(robot)
        _check_late_loop_closure(robot, clip, first, tmp_path)


def _check_surface(robot: Robot, clip: Clip) -> None:
    shown = {START_NS + stamp for stamp in clip.stamps_ns[:30]}
    wait_for(lambda: len(robot.corrected) >= len(robot.poses) > 20, 'a corrected pose for each')
    stamps = _stamps(robot.poses)
    assert set(stamps) <= shown and stamps == sorted(stamps)
    assert set(_stamps(robot.corrected)) == set(stamps), 'stamps are those of the images'
    assert {p.header.frame_id for p in (*robot.poses, *robot.odometry)} == {'odom'}
    assert {p.header.frame_id for p in robot.corrected} == {'map'}
    assert {o.child_frame_id for o in robot.odometry} == {CAMERA}
    assert {c.header.frame_id for c in robot.clouds} == {CAMERA}
    T_odom_cam = torch.stack([matrix(pose.pose) for pose in robot.poses])
    index = [clip.stamps_ns.index(stamp - START_NS) for stamp in stamps]
    assert ate(T_odom_cam, clip.T_world_cam[index]) < 0.1, 'metres; the focal length is a guess'
    # Nothing was corrected yet, so both frames are the same and z is up: the first camera looks
    # along x, its y axis points down.
    by_stamp = {stamp_ns(p.header.stamp): matrix(p.pose) for p in robot.corrected}
    for stamp, T in zip(stamps, T_odom_cam):
        torch.testing.assert_close(by_stamp[stamp], T, atol=1e-4, rtol=0.0)     # float32 tables
    first = sim3.identity() if stamps[0] != START_NS else T_odom_cam[0]
    torch.testing.assert_close(first[:3, :3], T_ZUP_OPTICAL[:3, :3], atol=1e-6, rtol=0.0)


def _check_keyframes(robot: Robot) -> None:
    """A keyframe's cloud, put where the event has its camera, is where points are; and TF has it
    there at its stamp, as well as following can tell before the model has been asked."""
    wait_for(lambda: robot.loop_closure_says('keyframes') == str(robot.frontend_has()),
             'loop closure to know all keyframes')
    wait_for(lambda: robot.map and robot.map[-1].width > 1000 and robot.path
             and len(robot.path[-1].poses) == len(set(_stamps(robot.poses))), 'map and path')
    assert robot.map[-1].header.frame_id == robot.path[-1].header.frame_id == 'map'
    received = {stamp_ns(t.header.stamp): keyframe_event(t, c).event
                for t, c in robot.keyframes()}
    T_odom_cam = {stamp_ns(p.header.stamp): matrix(p.pose) for p in robot.poses}
    newest = max(set(received) & set(_stamps(robot.points)) & set(T_odom_cam))
    event = received[newest]
    at_camera = event.points_cam[::2, ::2].reshape(-1, 3).double()
    expected = sim3.transform(T_ZUP_OPTICAL @ event.T_world_kf, at_camera)
    depth = float(sim3.scale_of(event.T_world_kf) * at_camera[:, 2].median())
    message = next(m for m in robot.points if stamp_ns(m.header.stamp) == newest)
    seen = torch.from_numpy(cloud_from_msg(message).points).double()
    gap = torch.cdist(seen[::50], expected).min(dim=1).values
    assert float(gap.max()) < 1e-3 * depth, 'of the depth: float32'
    moved = (T_ZUP_OPTICAL @ event.T_world_kf - T_odom_cam[newest])[:3, 3].norm()
    assert float(moved) < 0.05 * depth


def _check_late_loop_closure(robot: Robot, clip: Clip, first: Process, folder: Path) -> None:
    """Killed with -9 it is missed by nobody; another one asks for everything and goes on."""
    first.kill()
    robot.walk(clip, range(30, 36))
    robot._diagnostics.clear()
    with Process(folder / 'second.log', LOOP_CLOSURE, *SMALL) as second:
        wait_for(lambda: robot.loop_closure_says('keyframes') == str(robot.frontend_has()),
                 'all keyframes again')
        before = len(robot.corrected)
        robot.walk(clip, range(36, len(clip)))
        wait_for(lambda: len(robot.corrected) > before, 'corrected poses of the new one')
        second.signal(signal.SIGINT)
        assert second.ended(5.0) == 0 and 'Traceback' not in second.output, second.output


def test_a_restarted_frontend_begins_a_new_map(tmp_path: Path, clip: Clip) -> None:
    """Loop closure says so, saves the old map as it was told to, and follows the new one."""
    saved = tmp_path / 'maps'
    arguments = (*SMALL, '-p', 'save_on_new_session:=true', '-p', f'save_directory:={saved}')
    with Peer() as peer, \
            Process(tmp_path / 'loop_closure.log', LOOP_CLOSURE, *arguments) as loop_closure:
        with Process(tmp_path / 'first.log', FRONTEND, *SMALL) as frontend:
            robot = Robot(peer)
            wait_for(lambda: peer.node.count_subscribers('keyframe') >= 2, 'loop closure')
            robot.walk(clip, range(20))
            wait_for(lambda: robot.loop_closure_says('keyframes') not in ('', '0'), 'a keyframe')
            frontend.kill()
        with Process(tmp_path / 'again.log', FRONTEND, *SMALL) as frontend:
            again = Robot(peer, frontends=2)
            again.walk(clip, range(20), later_ns=10 ** 10)
            assert any(frame_report(row).result.status is TrackingStatus.TRACKED
                       for row in again.rows)
            for index in range(20, len(clip)):      # images go on until the nodes have met
                again.walk(clip, range(index, index + 1), later_ns=10 ** 10)
                if again.corrected:
                    break
                time.sleep(0.5)
            assert again.corrected and 'new map' in loop_closure.output, loop_closure.output
            wait_for(lambda: list(saved.glob('*/map.ply')), 'the old map')
            started = time.monotonic()
            for process in (frontend, loop_closure):
                process.signal(signal.SIGINT)
                process.signal(signal.SIGINT)
            assert [process.ended(5.0) for process in (frontend, loop_closure)] == [0, 0]
            assert time.monotonic() - started < 3.0
        assert 'Traceback' not in loop_closure.output, loop_closure.output


def test_both_nodes_in_one_process(tmp_path: Path, clip: Clip) -> None:
    with Peer() as peer, Process(tmp_path / 'slam.log', 'aim_slam_ros.cli.slam', *SMALL) as slam:
        robot = Robot(peer)
        robot.walk(clip, range(20))
        wait_for(lambda: len(robot.corrected) >= len(robot.poses) > 8, 'poses of both')
        wait_for(lambda: robot.map and robot.map[-1].width > 1000, 'a map')
        slam.signal(signal.SIGINT)
        assert slam.ended(5.0) == 0 and 'Traceback' not in slam.output, slam.output


def test_poses_leave_while_a_slow_model_works(tmp_path: Path) -> None:
    """One inference a second, images at 10 Hz: at least 80 % of them have a pose, and the map
    grows. The camera moves at a third of its speed: a slow model sees a slow world."""
    render('room', tmp_path / 'room', frames=slice(0, 132), size=clips.SIZE)
    sequence = load_sequence(tmp_path / 'room')
    slow = ('-p', 'model.min_inference_s:=1.0')
    with Peer() as peer, Process(tmp_path / 'frontend.log', FRONTEND, *SMALL, *slow):
        robot = Robot(peer)
        start = time.monotonic()
        for index in range(len(sequence)):
            time.sleep(max(0.0, start + 0.1 * index - time.monotonic()))
            stamp = START_NS + index * STEP_NS
            robot.camera.publish(images.image_msg(sequence.image(index), stamp, CAMERA))
        wait_for(lambda: stamp in _stamps(robot.rows), 'the last answer')
        sent_s = time.monotonic() - start
        in_time = len(set(_stamps(robot.poses)))
        assert in_time >= 0.8 * len(sequence), f'{in_time} poses of {len(sequence)}'
        reports = [frame_report(row) for row in robot.rows]
        asked = sum(report.result.inferences for report in reports)
        assert 3 <= asked <= sent_s + 1.0, 'it really was slow'
        assert robot.frontend_has() >= 4, 'the two that it began with, and more'
