"""What is heard on the topics, as a run: over real DDS, from messages of a run without ROS."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any, Callable, Iterator

import clip as clips
import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry, Path
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from aim_slam_ros import offline
from aim_slam_ros.datasets.base import Calibration, Sequence
from aim_slam_ros.evaluation import metrics
from aim_slam_ros.evaluation.run_result import RunResult
from aim_slam_ros.evaluation.trajectory import Incomparable
from aim_slam_ros.geometry import sim3
from aim_slam_ros.nodes.demo.collector import SPECS, Collector
from aim_slam_ros.nodes.demo.overview import overview
from aim_slam_ros.nodes.demo.received import Playback, received_run
from aim_slam_ros.nodes.demo.settling import frontend_is_idle, loop_closure_is_idle
from aim_slam_ros.types import (CorrectedKeyframes, FrameReport, FrameResult, KeyframePose,
                                TrackingStatus)
from msg_adapters import clouds, diagnostics, frames, keyframes, poses

SESSION = 7
NO_TRUTH = Incomparable('there is no ground truth')
TIMEOUT_S = 20.0
KINDS = {'pose': PoseStamped, 'odometry': Odometry, 'frame': PointCloud2, 'keyframe': PointCloud2,
         'corrected_pose': PoseStamped, 'keyframe_poses': PointCloud2, 'path': Path,
         'map': PointCloud2, 'pose_graph': MarkerArray, '/diagnostics': DiagnosticArray}
LATCHED = ('keyframe_poses', 'path', 'map', 'pose_graph')


class ClipSequence(Sequence):
    """The clip as a dataset."""

    def __init__(self, clip: clips.Clip) -> None:
        super().__init__('clip', np.array(clip.stamps_ns), Calibration(clip.K))
        self._clip = clip

    def image(self, index: int) -> np.ndarray:
        return self._clip.images[index]


@pytest.fixture(scope='module')
def run(clip: clips.Clip) -> RunResult:
    """Both pipelines over the clip, without ROS."""
    sequence = ClipSequence(clip)
    return offline.run(sequence, clips.config(), range(len(sequence)))


@dataclass(frozen=True)
class Wire:
    """The publishers of both nodes in one, and the collector that hears them."""

    collector: Collector
    publishers: dict[str, Any]

    def send(self, topic: str, message: Any) -> None:
        self.publishers[topic].publish(message)

    def heard(self, **counts: int) -> None:
        """Wait for so many messages."""
        wait_for(lambda: all(self.collector.topics[name].messages >= count
                             for name, count in counts.items()))


def wait_for(condition: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + TIMEOUT_S
    while not condition():
        assert time.monotonic() < deadline_s, 'it did not come'
        time.sleep(0.01)


@pytest.fixture
def wire() -> Iterator[Wire]:
    rclpy.init()
    collector, node = Collector(), Node('nodes')
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    publishers = {name: node.create_publisher(kind, name, latched if name in LATCHED
                                              else QoSProfile(depth=1000))
                  for name, kind in KINDS.items()}
    try:
        wait_for(lambda: not collector.missing([])
                 and all(p.get_subscription_count() for p in publishers.values()))
        yield Wire(collector, publishers)
    finally:
        collector.close()
        node.destroy_node()
        rclpy.shutdown()


def report(result: FrameResult, session_id: int = SESSION, dropped: int = 0) -> Any:
    return frames.frame_message(FrameReport(session_id, result, result.T_world_cam, dropped),
                                'odom')


def send_frontend(wire: Wire, run: RunResult, left_out: frozenset[int] = frozenset()) -> None:
    """What a frontend node publishes in the course of the run; rows of ``left_out`` are not."""
    late = {waited.stamp_ns: waited for result in run.results for waited in result.late}
    for result in run.results:
        if result.stamp_ns in left_out:
            continue
        if result.stamp_ns in late:
            wire.send('frame', report(FrameResult(
                result.stamp_ns, TrackingStatus.INITIALISING, inferences=result.inferences,
                stage_s=result.stage_s)))
            continue
        for placed in (*result.late, result):
            wire.send('frame', report(placed))
            if placed.T_world_cam is not None:
                wire.send('pose', poses.pose_stamped(poses.T_ZUP_OPTICAL @ placed.T_world_cam,
                                                     placed.stamp_ns, 'odom'))
        for event in result.events:
            wire.send('keyframe', keyframes.keyframe_messages(event, SESSION, 'camera',
                                                              'map').table)


def send_loop_closure(wire: Wire, run: RunResult) -> None:
    """What a loop-closure node has published at the end of the run."""
    corrected = CorrectedKeyframes(
        1, tuple(KeyframePose(k.keyframe_id, k.T_world_kf) for k in run.keyframes),
        {k.keyframe_id: k.piece_id for k in run.keyframes})
    stamps_ns = {k.keyframe_id: k.stamp_ns for k in run.keyframes}
    newest_ns = max(stamps_ns.values())
    wire.send('keyframe_poses', keyframes.correction_message(corrected, stamps_ns, SESSION, 'map',
                                                             newest_ns))
    path = run.trajectory
    wire.send('path', poses.path(path.stamps_ns.tolist(),
                                 poses.T_ZUP_OPTICAL.numpy() @ path.T_world_cam, 'map'))
    R = poses.T_ZUP_OPTICAL[:3, :3].float().numpy()
    wire.send('map', clouds.cloud_msg(run.map_cloud.points @ R.T, run.map_cloud.colours,
                                      newest_ns, 'map'))
    send_status(wire, 'loop closure', loops=len(run.loops), pending_keyframes=0,
                keyframes=len(run.keyframes))


def send_status(wire: Wire, what: str, **values: str | float | int) -> None:
    wire.send('/diagnostics', diagnostics.diagnostics_msg(f'/node: {what}', diagnostics.OK, '',
                                                          values, 1))


def rows_of(run: RunResult) -> int:
    return len(run.results) + sum(len(result.late) for result in run.results)


def test_every_topic_of_the_table_is_listened_to() -> None:
    assert {spec.name: spec.kind for spec in SPECS} == KINDS
    assert {spec.name for spec in SPECS if spec.latched} == set(LATCHED)


def test_the_run_that_is_heard_is_the_run_that_was(wire: Wire, run: RunResult) -> None:
    begun_ns = time.monotonic_ns()
    published_ns = {result.stamp_ns: begun_ns for result in run.results}
    send_frontend(wire, run)
    wire.heard(frame=rows_of(run), pose=len(run.causal_trajectory))
    send_loop_closure(wire, run)
    wire.heard(**{'keyframe_poses': 1, 'path': 1, 'map': 1, '/diagnostics': 1})
    spent_ms = (time.monotonic_ns() - begun_ns) / 1e6
    heard = received_run(wire.collector.topics, Playback(published_ns, len(run.results), False))
    for mine, theirs in ((heard.trajectory, run.trajectory),
                         (heard.causal_trajectory, run.causal_trajectory),
                         (heard.keyframe_trajectory, run.keyframe_trajectory)):
        np.testing.assert_array_equal(mine.stamps_ns, theirs.stamps_ns)
        # float64 through a quaternion, for keyframes float32 of values of some metres
        tolerance = 1e-5 if theirs is run.keyframe_trajectory else 1e-9
        np.testing.assert_allclose(mine.T_world_cam, theirs.T_world_cam, atol=tolerance)
    np.testing.assert_allclose(heard.map_cloud.points, run.map_cloud.points, atol=1e-6)
    np.testing.assert_array_equal(heard.map_cloud.colours, run.map_cloud.colours)
    for mine_kf, theirs_kf in zip(heard.keyframes, run.keyframes, strict=True):
        assert mine_kf.keyframe_id == theirs_kf.keyframe_id
        # float32 columns, of values of some metres
        np.testing.assert_allclose(mine_kf.T_world_kf, theirs_kf.T_world_kf, atol=1e-5)
    assert heard.late == run.late > 0
    latency_ms = heard.delivery.latency_ms
    assert len(latency_ms) == len(run.causal_trajectory) - run.late
    assert heard.delivery.late_poses == run.late
    assert 0.0 < latency_ms.min() and latency_ms.max() < spent_ms


def test_figures_are_those_of_the_run_and_of_the_delivery(wire: Wire, run: RunResult) -> None:
    """Three images that the frontend said nothing about were dropped."""
    gone = frozenset(r.stamp_ns for r in run.tracked[-3:] if not r.events)
    assert len(gone) == 3
    send_frontend(wire, run, left_out=gone)
    wire.heard(frame=rows_of(run) - 3)
    send_loop_closure(wire, run)
    wire.heard(**{'keyframe_poses': 1, 'path': 1, 'map': 1, '/diagnostics': 1})
    heard = received_run(wire.collector.topics, Playback({}, len(run.results), False))
    ours, theirs = (metrics.compute(r, None, NO_TRUTH) for r in (heard, run))
    assert ours['frames_dropped'] == 3 and ours['frames_delivered'] == len(run.results) - 3
    assert ours['dropped_percent'] == pytest.approx(300 / len(run.results))
    assert ours['frames_tracked'] == len(run.tracked) - 3
    assert ours['tracked_of_delivered_percent'] == pytest.approx(
        100 * (len(run.tracked) - 3) / (len(run.results) - 3))
    for name in ('frames_offered', 'frames_late', 'frames_lost', 'frames_initialising',
                 'map_pieces', 'map_points', 'keyframes', 'loops', 'inferences', 'mean_window'):
        assert ours[name] == theirs[name], name
    assert ours['messages_frame'] == rows_of(run) - 3
    assert ours['latency_ms_p50'] is None      # it is not known when they were published
    assert 'frames_dropped' not in theirs


def test_a_keyframe_is_where_its_last_message_says(wire: Wire, run: RunResult) -> None:
    """Without a word of loop closure: the newest of its own and of those that moved it."""
    events = [event for result in run.results for event in result.events][:2]
    pulled = KeyframePose(events[0].keyframe_id, events[1].T_world_kf)
    for event in (events[0], replace(events[1], moved=(pulled,))):
        wire.send('keyframe', keyframes.keyframe_messages(event, SESSION, 'camera', 'map').table)
    wire.send('frame', report(run.tracked[0]))
    wire.heard(keyframe=2, frame=1)
    placed = received_run(wire.collector.topics, Playback({}, 1, False)).keyframes
    assert [k.keyframe_id for k in placed] == [event.keyframe_id for event in events]
    for keyframe in placed:
        np.testing.assert_allclose(keyframe.T_world_kf, events[1].T_world_kf, atol=1e-5)


def test_the_path_tells_where_a_keyframe_is_that_a_correction_lacks(wire: Wire,
                                                                    run: RunResult) -> None:
    """It was told of while the correction was on its way: in the world and piece before it."""
    first, second = [replace(event, piece_id=1) for result in run.results
                     for event in result.events][:2]
    for event in (first, second):
        wire.send('keyframe', keyframes.keyframe_messages(event, SESSION, 'camera', 'map').table)
    wire.send('keyframe_poses', keyframes.correction_message(
        CorrectedKeyframes(1, (KeyframePose(first.keyframe_id, first.T_world_kf),),
                           {first.keyframe_id: 0}),
        {first.keyframe_id: first.stamp_ns}, SESSION, 'map', first.stamp_ns))
    T_world_cam = run.tracked[-1].T_world_cam
    assert T_world_cam is not None
    wire.send('path', poses.path([second.stamp_ns], [poses.T_ZUP_OPTICAL @ T_world_cam], 'map'))
    wire.send('frame', report(run.tracked[0]))
    wire.heard(keyframe=2, keyframe_poses=1, path=1, frame=1)
    placed = received_run(wire.collector.topics, Playback({}, 1, False)).keyframes
    expected = sim3.with_scale(T_world_cam, sim3.scale_of(second.T_world_kf))
    np.testing.assert_allclose(placed[0].T_world_kf, first.T_world_kf, atol=1e-5)
    np.testing.assert_allclose(placed[1].T_world_kf, expected, atol=1e-5)
    assert [keyframe.piece_id for keyframe in placed] == [0, 0]


def test_only_the_last_session_has_poses(wire: Wire, run: RunResult) -> None:
    """The images of a frontend that was restarted were delivered, but belong to no map."""
    event = next(event for result in run.results for event in result.events)
    tracked = [replace(r, reference_id=event.keyframe_id, late=()) for r in run.tracked[:6]]
    wire.send('keyframe', keyframes.keyframe_messages(event, SESSION + 1, 'camera', 'map').table)
    for n, result in enumerate(tracked):
        wire.send('frame', report(result, SESSION + (n >= 4)))
    wire.heard(keyframe=1, frame=6)
    heard = received_run(wire.collector.topics, Playback({}, 6, False))
    assert len(heard.results) == 6
    assert [r.stamp_ns for r in heard.tracked] == [r.stamp_ns for r in tracked[4:]]


def test_a_repeated_stamp_does_not_unplace_its_image(wire: Wire, run: RunResult) -> None:
    """The bag has it twice; the frontend skips the second."""
    result = next(r for r in run.results if r.status is TrackingStatus.TRACKED)
    again = FrameResult(result.stamp_ns, TrackingStatus.SKIPPED, reason='not newer')
    for answer in (result, again):
        wire.send('frame', frames.frame_message(
            FrameReport(SESSION, answer, answer.T_world_cam, 0), 'odom'))
    wire.heard(frame=2)
    heard = received_run(wire.collector.topics, Playback({}, 2, False))
    assert [r.status for r in heard.results] == [TrackingStatus.TRACKED]


def test_nothing_heard_is_a_run_too(wire: Wire) -> None:
    heard = received_run(wire.collector.topics, Playback({5: 1}, 1, True))
    figures = metrics.compute(heard, None, NO_TRUTH)
    assert figures['frames_dropped'] == 1 and figures['frames_tracked'] == 0
    assert figures['tracked_of_delivered_percent'] is None and figures['interrupted'] is True
    assert str(overview(wire.collector.topics)).startswith('no answer yet')


def test_it_tells_how_far_the_nodes_are(wire: Wire, run: RunResult) -> None:
    event = next(event for result in run.results for event in result.events)
    for _ in range(2):      # once more when it was known better
        wire.send('keyframe', keyframes.keyframe_messages(event, SESSION, 'camera', 'map').table)
    wire.send('frame', report(run.tracked[0], dropped=4))
    send_status(wire, 'loop closure', loops=2)
    wire.heard(**{'keyframe': 2, 'frame': 1, '/diagnostics': 1})
    assert str(overview(wire.collector.topics)) == 'tracked, 1 keyframes, 2 loops, 4 dropped'


def test_the_frontend_is_idle_when_it_says_so_after_the_last_image(wire: Wire,
                                                                   run: RunResult) -> None:
    topics, last_ns = wire.collector.topics, run.results[-1].stamp_ns
    send_status(wire, 'tracking', model_busy='false')
    wire.heard(**{'/diagnostics': 1})
    assert not frontend_is_idle(topics, last_ns)
    wire.send('frame', report(run.results[-1]))
    wire.heard(frame=1)
    assert not frontend_is_idle(topics, last_ns)    # that word was of before
    send_status(wire, 'tracking', model_busy='true')
    wire.heard(**{'/diagnostics': 2})
    assert not frontend_is_idle(topics, last_ns)
    send_status(wire, 'tracking', model_busy='false')
    wire.heard(**{'/diagnostics': 3})
    assert frontend_is_idle(topics, last_ns)


def test_loop_closure_is_idle_when_path_and_map_hold_everything(wire: Wire,
                                                                run: RunResult) -> None:
    topics = wire.collector.topics
    assert loop_closure_is_idle(topics)     # there is nothing that it could wait for
    send_frontend(wire, run)
    wire.heard(frame=rows_of(run), keyframe=len(run.keyframes))
    assert not loop_closure_is_idle(topics)
    send_status(wire, 'loop closure', loops=0, pending_keyframes=1)
    send_loop_closure(wire, run)
    wire.heard(**{'keyframe_poses': 1, 'path': 1, 'map': 1, '/diagnostics': 2})
    assert loop_closure_is_idle(topics)
    short = run.trajectory
    wire.send('path', poses.path(short.stamps_ns[:-1].tolist(),
                                 poses.T_ZUP_OPTICAL.numpy() @ short.T_world_cam[:-1], 'map'))
    wire.heard(path=2)
    assert not loop_closure_is_idle(topics)
