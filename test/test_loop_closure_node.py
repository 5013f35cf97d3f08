"""The loop-closure node as a process, over real DDS, beside a frontend of the tests' own."""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Iterator

import clip as clips
import numpy as np
import pytest
import room_walk
import torch
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from keyframe_source import (KeyframeSource, image_at, stamps_of, tracked_images, unlike,
                             walk_with_a_loop)
from nav_msgs.msg import Path as PathMessage
from rclpy.qos import DurabilityPolicy, QoSProfile
from ros_peer import Peer, Process, wait_for
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import Trigger
from torch import Tensor
from visualization_msgs.msg import MarkerArray

from aim_slam_ros.config import Config
from aim_slam_ros.datasets.text import read_tum_trajectory
from aim_slam_ros.geometry import sim3
from aim_slam_ros.loop_closure.pipeline import LoopClosurePipeline
from aim_slam_ros.models import make_model
from aim_slam_ros.types import KeyframeEvent
from msg_adapters import diagnostics, keyframes
from msg_adapters.clouds import cloud_from_msg
from msg_adapters.keyframes import keyframe_messages
from msg_adapters.poses import T_ZUP_OPTICAL, matrix
from msg_adapters.stamps import stamp_ns

MODULE = 'aim_slam_ros.cli.loop_closure'
FIRST, SECOND = 11, 22      # sessions
ROUNDING = 1e-4             # poses travel as float32, coordinates here are below 10


# The wheels of ROS 2 lack tf2_ros; the node finds this in its working directory.
TF = """
class TransformBroadcaster:
    def __init__(self, node):
        pass

    def sendTransform(self, sent):
        t, q = sent.transform.translation, sent.transform.rotation
        print('TF', sent.header.frame_id, sent.child_frame_id, t.x, t.y, t.z, q.x, q.y, q.z, q.w,
              flush=True)
"""


class Ears:
    """What the node publishes."""

    def __init__(self, peer: Peer) -> None:
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.corrected = peer.hear(PoseStamped, 'corrected_pose')
        self.keyframe_poses = peer.hear(PointCloud2, 'keyframe_poses', latched)
        self.path = peer.hear(PathMessage, 'path', latched)
        self.map = peer.hear(PointCloud2, 'map', latched)
        self.pose_graph = peer.hear(MarkerArray, 'pose_graph', latched)
        self._diagnostics = peer.hear(DiagnosticArray, '/diagnostics')

    def value(self, name: str) -> str:
        """The newest word of the node on itself."""
        if not self._diagnostics:
            return ''
        return diagnostics.values_of(self._diagnostics[-1],
                                     '/loop_closure: loop closure').get(name, '')

    @property
    def state(self) -> str:
        return self._diagnostics[-1].status[0].message if self._diagnostics else ''

    def until(self, **values: int) -> None:
        """Wait for diagnostics that say so."""
        for name, value in values.items():
            wait_for(lambda: self.value(name) == str(value), f'{name} {value}')

    def path_has(self, count: int) -> list[Any]:
        wait_for(lambda: self.path and len(self.path[-1].poses) == count,
                 f'a path of {count} images')
        return list(self.path[-1].poses)

    def graph_has(self, keyframes: int) -> None:
        wait_for(lambda: self.pose_graph
                 and len(self.pose_graph[-1].markers[0].points) == keyframes,
                 f'a pose graph of {keyframes} keyframes')


@dataclass(frozen=True)
class Stage:
    """The node, and what stands around it."""

    process: Process
    peer: Peer
    source: KeyframeSource
    ears: Ears
    saved: Path


@pytest.fixture
def peer() -> Iterator[Peer]:
    with Peer() as made:
        yield made


def start(folder: Path, name: str = 'node') -> Process:
    values = {'save_directory': folder / 'maps', 'save_on_new_session': 'true', 'gap_s': 0.5,
              'map_period_s': 0.2, 'path_period_s': 0.2, 'silence_s': 1.0,
              'camera.width': clips.WIDTH}
    parameters = [word for key, value in values.items() for word in ('-p', f'{key}:={value}')]
    return Process(folder / f'{name}.log', MODULE, '--ros-args', *parameters)


def test_its_life(peer: Peer, tmp_path: Path, clip: clips.Clip) -> None:
    """Two maps: of a real frontend, and of a walk with a loop."""
    ears = Ears(peer)
    (tmp_path / 'tf2_ros.py').write_text(TF)
    with start(tmp_path) as process:
        stage = Stage(process, peer, KeyframeSource(peer), ears, tmp_path / 'maps')
        _nothing_to_save(stage)
        _asks_for_keyframes(stage)
        _maps_what_the_frontend_saw(stage, clip)
        _shows_what_became_better(stage)
        _begins_anew_with_another_session(stage)
        _corrects(stage)
        _forgets_and_asks_again_when_reset(stage)
        process.signal()
        assert process.ended() == 0 and 'Traceback' not in process.output


def _nothing_to_save(stage: Stage) -> None:
    answer = stage.peer.call(Trigger, 'loop_closure/save_map')
    assert not answer.success and 'no map yet' in answer.message


def _asks_for_keyframes(stage: Stage) -> None:
    stage.process.says('asked the frontend for its keyframes: 0 keyframes follow')
    assert stage.process.output.count('asked the frontend') == 1


def _maps_what_the_frontend_saw(stage: Stage, clip: clips.Clip) -> None:
    stage.source.begin(FIRST)
    images = tracked_images(clip, 24)
    for result in images:
        stage.source.frame(result, result.T_world_cam)
        for k, event in enumerate(result.events):
            stage.source.keyframe(event, cloud_first=bool(k % 2))
    stamps = stamps_of(images)
    assert len(stamps) == 24
    _each_image_has_its_pose(stage, images)
    path = stage.ears.path_has(24)
    assert [stamp_ns(p.header.stamp) for p in path] == sorted(stamps)
    truth = {r.stamp_ns: r.T_world_cam for r in images}
    for pose in path:       # nothing was corrected: as the frontend saw it
        T = truth[stamp_ns(pose.header.stamp)]
        assert T is not None and pose.header.frame_id == 'map'
        np.testing.assert_allclose(matrix(pose.pose), z_up(T), atol=ROUNDING)
    stage.ears.graph_has(len(stage.source.events))
    cloud = cloud_from_msg(stage.ears.map[-1])
    assert len(cloud.points) > 1000 and bool(np.isfinite(cloud.points).all())
    # The room is seen ahead, along x; a camera's y axis points down, and the floor with it.
    assert np.median(cloud.points[:, 0]) > 0.5 and cloud.points[:, 2].min() < 0.0
    assert stage.ears.map[-1].header.frame_id == 'map'
    assert not stage.ears.keyframe_poses, 'there was no loop'
    _saves(stage, len(stamps), len(cloud.points))


def _each_image_has_its_pose(stage: Stage, images: list[Any]) -> None:
    tracked = [r for r in images if r.T_world_cam is not None]
    wait_for(lambda: len(stage.ears.corrected) == len(tracked), 'corrected poses')
    for result, pose in zip(tracked, stage.ears.corrected):
        assert stamp_ns(pose.header.stamp) == result.stamp_ns
        assert pose.header.frame_id == 'map'
        np.testing.assert_allclose(matrix(pose.pose), z_up(result.T_world_cam), atol=ROUNDING)


def _saves(stage: Stage, images: int, points: int) -> None:
    answer = stage.peer.call(Trigger, 'loop_closure/save_map')
    assert answer.success, answer.message
    folder = Path(answer.message)
    assert folder.parent == stage.saved
    header = (folder / 'map.ply').read_bytes()[:200]
    assert f'element vertex {points}'.encode() in header
    assert len(read_tum_trajectory(folder / 'trajectory.txt')) == images
    assert len(read_tum_trajectory(folder / 'keyframes.txt')) == len(stage.source.events)
    assert 'loop_closure:' in (folder / 'config.yaml').read_text()
    written = read_tum_trajectory(folder / 'trajectory.txt').T_world_cam
    for T, pose in zip(written, stage.ears.path[-1].poses):
        np.testing.assert_allclose(T, matrix(pose.pose), atol=1e-6)


def _shows_what_became_better(stage: Stage) -> None:
    """Not what is merely sent again."""
    path, before = len(stage.ears.path[-1].poses), cloud_from_msg(stage.ears.map[-1]).points
    requests = stage.source.requests
    event = stage.source.events[0]
    further = dataclasses.replace(event, points_cam=1.1 * event.points_cam)
    stage.source.send(further)
    better = dataclasses.replace(further, observations=3)

    def shown() -> bool:
        stage.source.send(better)       # table and cloud of two tellings may come mixed at once
        time.sleep(0.5)
        return not np.array_equal(cloud_from_msg(stage.ears.map[-1]).points, before)
    wait_for(shown, 'a map with the better keyframe')
    after = cloud_from_msg(stage.ears.map[-1]).points
    assert before[:, 0].max() < after[:, 0].max() < 1.2 * before[:, 0].max(), 'ahead, along x'
    assert len(stage.ears.path[-1].poses) == path and stage.source.requests == requests


def _begins_anew_with_another_session(stage: Stage) -> None:
    """The old map is saved as asked for; what still comes of it is passed over."""
    corrected = len(stage.ears.corrected)
    stage.source.begin(SECOND)
    events = walk_with_a_loop()
    for event in events[:-1]:
        _sends_keyframe_and_image(stage, event)
    stage.process.says('a new map begins')
    stage.process.says('the old map was saved in')
    assert len(list(stage.saved.iterdir())) == 2
    stage.ears.until(keyframes=len(events) - 1, session=SECOND)
    assert len(stage.ears.path_has(len(events) - 1)) == len(events) - 1
    stage.source.frame(image_at(events[0], 0.1, 5), sim3.identity(), session_id=FIRST)
    stage.ears.until(old_session_messages=1)
    assert len(stage.ears.corrected) == corrected + len(events) - 1


def _sends_keyframe_and_image(stage: Stage, event: KeyframeEvent) -> None:
    """What is lost on a busy machine is asked for, since the image tells that it exists."""
    image = image_at(event, 0.1, event.stamp_ns)
    stage.source.frame(image, image.T_world_cam)
    stage.source.keyframe(event)
    time.sleep(0.03)    # reliable delivery keeps the last 20


def _corrects(stage: Stage) -> None:
    """As the pipeline alone does."""
    events = walk_with_a_loop()
    pipeline = LoopClosurePipeline(Config(), make_model(Config()))
    corrected = [pipeline.add(event) for event in events][-1]
    assert corrected is not None
    _sends_keyframe_and_image(stage, events[-1])
    wait_for(lambda: stage.ears.keyframe_poses, 'a correction')
    received = keyframes.correction(stage.ears.keyframe_poses[-1])
    assert received.session_id == SECOND and received.corrected.version == 1
    assert received.stamps_ns == {e.keyframe_id: e.stamp_ns for e in events}
    assert received.corrected.pieces == corrected.pieces
    # The graph passes the rounding of its edges on along the walk.
    T_world_kf = {p.keyframe_id: p.T_world_kf for p in received.corrected.poses}
    assert torch.allclose(torch.stack([T_world_kf[e.keyframe_id] for e in events]),
                          torch.stack([p.T_world_kf for p in corrected.poses]), atol=0.01)
    _places_images_in_the_corrected_map(stage, events, T_world_kf)
    stage.ears.graph_has(len(events))


def _places_images_in_the_corrected_map(stage: Stage, events: list[KeyframeEvent],
                                        T_world_kf: dict[int, Tensor]) -> None:
    """Those before the correction on the path, those after it at once."""
    before = len(stage.ears.corrected)
    image = image_at(events[20], 0.2, events[-1].stamp_ns + 1)
    assert image.T_kf_cam is not None and image.T_world_cam is not None
    stage.source.frame(image, image.T_world_cam)
    wait_for(lambda: len(stage.ears.corrected) > before, 'a corrected pose')
    T_map_cam = z_up(T_world_kf[20] @ image.T_kf_cam)
    np.testing.assert_allclose(matrix(stage.ears.corrected[-1].pose), T_map_cam, atol=ROUNDING)
    _carries_odom_to_the_map(stage, T_map_cam, z_up(image.T_world_cam))
    assert float((sim3.translation_of(T_world_kf[20]) - sim3.translation_of(
        events[20].T_world_kf)).norm()) > 100 * ROUNDING, 'it was really corrected'
    path = stage.ears.path_has(len(events) + 1)
    assert stamp_ns(path[-1].header.stamp) == image.stamp_ns
    for pose, event in zip(path, events):
        T_kf_cam = image_at(event, 0.1, event.stamp_ns).T_kf_cam
        assert T_kf_cam is not None
        np.testing.assert_allclose(matrix(pose.pose), z_up(
            T_world_kf[event.keyframe_id] @ T_kf_cam), atol=ROUNDING)


def _carries_odom_to_the_map(stage: Stage, T_map_cam: np.ndarray, T_odom_cam: np.ndarray) -> None:
    """TF's chain from map over odom to the camera is the corrected pose."""
    sent = [line.split()[1:] for line in stage.process.output.splitlines()
            if line.startswith('TF ')][-1]
    assert sent[:2] == ['map', 'odom']
    x, y, z, *quaternion = (float(number) for number in sent[2:])
    T_map_odom = sim3.from_parts(1.0, sim3.rotation_from_quaternion(torch.tensor(quaternion)),
                                 torch.tensor([x, y, z]))
    np.testing.assert_allclose(T_map_odom.numpy() @ T_odom_cam, T_map_cam, atol=ROUNDING)


def _forgets_and_asks_again_when_reset(stage: Stage) -> None:
    """The path keeps its images: the frontend sends keyframes again, but not images."""
    requests, corrections = stage.source.requests, len(stage.ears.keyframe_poses)
    assert stage.peer.call(Trigger, 'loop_closure/reset').success
    wait_for(lambda: stage.source.requests > requests, 'a request to resend')
    wait_for(lambda: len(stage.ears.keyframe_poses) > corrections, 'the same correction again')
    stage.ears.until(keyframes=33, map_version=1, session=SECOND)
    stage.ears.path_has(34)


def test_poses_do_not_wait_for_the_model(peer: Peer, tmp_path: Path) -> None:
    """A keyframe may take seconds; here it takes for ever, and the end does not wait either."""
    ears = Ears(peer)
    with Process(tmp_path / 'stuck.log', 'stuck_loop_closure') as process:
        source = KeyframeSource(peer)
        source.begin(FIRST)
        stage = Stage(process, peer, source, ears, tmp_path)
        events = room_walk.drifting_events(0.15)
        for event in events:
            source.keyframe(event)
            time.sleep(0.03)
            if 'the model is asked' in process.output:
                break
        process.says('the model is asked')
        images = [image_at(events[0], 0.01 * k, 10 ** 9 + k) for k in range(20)]
        for k, image in enumerate(images):
            source.frame(image, image.T_world_cam)
            # 2 ms on an idle machine
            wait_for(lambda: len(ears.corrected) > k, 'a corrected pose', timeout_s=1.0)
        T_world_cam = images[-1].T_world_cam
        assert T_world_cam is not None
        np.testing.assert_allclose(matrix(ears.corrected[-1].pose), z_up(T_world_cam),
                                   atol=ROUNDING)
        wait_for(lambda: int(ears.value('pending_keyframes') or 0) > 0, 'waiting keyframes')
        _ends_at_once_when_interrupted_twice(stage)


def test_its_troubles(peer: Peer, tmp_path: Path) -> None:
    """Killed, restarted, fed with rubbish, left alone, interrupted twice."""
    ears = Ears(peer)
    with start(tmp_path, 'killed') as process:
        source = KeyframeSource(peer)
        source.begin(FIRST)
        events = walk_with_a_loop()
        for event in events[:5]:
            source.keyframe(event)
        ears.until(keyframes=5)
        process.kill()
    for event in events[5:]:
        source.events[event.keyframe_id] = event        # while nobody listened
    with start(tmp_path, 'restarted') as process:
        stage = Stage(process, peer, source, ears, tmp_path / 'maps')
        _carries_on(stage, len(events))
        _survives_wrong_messages(stage, events)
        _asks_for_what_was_lost(stage, events)
        _notices_that_the_frontend_is_gone(stage)
        _ends_at_once_when_interrupted_twice(stage)


def _carries_on(stage: Stage, count: int) -> None:
    # Not the count of requests: the killed process may have died before its own.
    stage.process.says(f'asked the frontend for its keyframes: {count} keyframes follow')
    wait_for(lambda: stage.ears.keyframe_poses, 'the correction')
    stage.ears.until(keyframes=count, map_version=1)
    assert keyframes.correction(stage.ears.keyframe_poses[-1]).corrected.version == 1


def _survives_wrong_messages(stage: Stage, events: list[KeyframeEvent]) -> None:
    """Each is counted; the one without a counterpart only waits."""
    good = keyframe_messages(unlike(events[3], 40, 2), FIRST, 'camera', 'map')
    stage.source.raw(frame=PointCloud2())
    stage.source.raw(frame=good.table)
    broken = keyframe_messages(unlike(events[3], 41, 2), FIRST, 'camera', 'map')
    broken.cloud.data = broken.cloud.data[:100]
    stage.source.raw(broken.table, broken.cloud)
    stage.source.raw(table=good.table)
    stage.ears.until(unusable_messages=3, keyframes=len(events))
    # A descriptor of another model: the adapter cannot know.
    other = dataclasses.replace(unlike(events[3], len(events), 2), descriptor=torch.ones(7))
    stage.source.send(other)
    stage.ears.until(unusable_keyframes=1)
    assert stage.process.alive and 'Traceback' not in stage.process.output


def _asks_for_what_was_lost(stage: Stage, events: list[KeyframeEvent]) -> None:
    last = len(events)      # the one with the wrong descriptor
    lost, next_one = unlike(events[4], last + 1, last - 1), unlike(events[5], last + 2, last + 1)
    stage.source.events[lost.keyframe_id] = lost
    requests = stage.source.requests
    stage.source.keyframe(next_one)
    wait_for(lambda: stage.source.requests > requests, 'a request for the lost keyframe')
    stage.ears.until(keyframes=last + 3, missing_keyframes=0)


def _notices_that_the_frontend_is_gone(stage: Stage) -> None:
    wait_for(lambda: 'nothing came from the frontend' in stage.ears.state, 'silence')
    stage.source.fall_silent()
    wait_for(lambda: stage.ears.state == 'the frontend is gone', 'its absence')


def _ends_at_once_when_interrupted_twice(stage: Stage) -> None:
    begin = time.monotonic()
    stage.process.signal()
    time.sleep(0.05)        # a second Ctrl-C while the first is at work
    stage.process.signal()
    assert stage.process.ended() == 0
    assert time.monotonic() - begin < 3.0
    assert 'Traceback' not in stage.process.output


def z_up(T: Tensor) -> np.ndarray:
    """Rigid, in the map frame."""
    return (T_ZUP_OPTICAL @ sim3.rigid_part(T)).numpy()
