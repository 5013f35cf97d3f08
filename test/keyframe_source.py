"""A frontend of the tests' own: real messages of known keyframes, sent when a test wants it."""

from __future__ import annotations

import dataclasses
from collections import deque
from typing import Any, Iterable

import clip as clips
import room_walk
import torch
from ros_peer import Peer
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import Trigger
from torch import Tensor

from aim_slam_ros.frontend.pipeline import FrontendPipeline
from aim_slam_ros.geometry import sim3
from aim_slam_ros.models import make_model
from aim_slam_ros.types import FrameReport, FrameResult, KeyframeEvent, TrackingStatus
from msg_adapters.frames import frame_message
from msg_adapters.keyframes import keyframe_messages

_RESEND_S = 0.03        # between two keyframes: reliable delivery keeps the last 20


class KeyframeSource:
    """What of the frontend other nodes see."""

    def __init__(self, peer: Peer) -> None:
        self._table = peer.publisher(PointCloud2, 'keyframe', 20)
        self._cloud = peer.publisher(PointCloud2, 'keyframe_cloud', 20)
        self._frame = peer.publisher(PointCloud2, 'frame', 100)
        self._resending: deque[KeyframeEvent] = deque()
        self._peer = peer
        self.session_id = 0
        self.events: dict[int, KeyframeEvent] = {}
        self.requests = 0
        peer.node.create_service(Trigger, 'frontend/resend_keyframes', self._resend)
        peer.node.create_timer(_RESEND_S, self._resend_one)

    def begin(self, session_id: int) -> None:
        """A new run of the frontend."""
        self.session_id, self.events = session_id, {}
        self._resending.clear()

    def keyframe(self, event: KeyframeEvent, cloud_first: bool = False) -> None:
        self.events[event.keyframe_id] = event
        self.send(event, cloud_first)

    def send(self, event: KeyframeEvent, cloud_first: bool = False) -> None:
        """The two messages alone; the keyframe is not known when it is asked for."""
        messages = keyframe_messages(event, self.session_id, 'camera', 'map')
        sends = [(self._table, messages.table), (self._cloud, messages.cloud)]
        for publisher, message in reversed(sends) if cloud_first else sends:
            publisher.publish(message)

    def raw(self, table: PointCloud2 | None = None, cloud: PointCloud2 | None = None,
            frame: PointCloud2 | None = None) -> None:
        """Messages as they are."""
        for publisher, message in ((self._table, table), (self._cloud, cloud),
                                   (self._frame, frame)):
            if message is not None:
                publisher.publish(message)

    def frame(self, result: FrameResult, T_odom_cam: Tensor | None,
              session_id: int | None = None) -> None:
        report = FrameReport(self.session_id if session_id is None else session_id, result,
                             T_odom_cam)
        self._frame.publish(frame_message(report, 'odom'))

    def fall_silent(self) -> None:
        """As a frontend that was killed."""
        for publisher in (self._table, self._cloud, self._frame):
            self._peer.node.destroy_publisher(publisher)

    def _resend(self, request: Any, response: Trigger.Response) -> Trigger.Response:
        self.requests += 1
        self._resending.extend(self.events.values())
        response.success, response.message = True, f'{len(self.events)} keyframes follow'
        return response

    def _resend_one(self) -> None:
        if self._resending:
            self.send(self._resending.popleft())


def tracked_images(clip: clips.Clip, count: int) -> list[FrameResult]:
    """What the real frontend makes of the clip's first images, late ones in their turn."""
    config = clips.config()
    pipeline = FrontendPipeline(config, make_model(config))
    results = [pipeline.process(clip.stamps_ns[i], clip.images[i], clip.K) for i in range(count)]
    return [told for r in results for told in (*r.late, r)]


def walk_with_a_loop() -> list[KeyframeEvent]:
    """The room walk, whose last keyframe was measured against the first: no model is needed."""
    events = room_walk.drifting_events(0.15)
    T_true = room_walk.true_poses([0, len(events) - 1])
    last = events[-1]
    across = dataclasses.replace(last.edges[0], a=0, T_a_b=sim3.inverse(T_true[0]) @ T_true[1])
    events[-1] = dataclasses.replace(last, edges=(*last.edges, across))
    # Nothing is retrieved by its looks.
    return [dataclasses.replace(e, descriptor=torch.ones(4)) for e in events]


def image_at(event: KeyframeEvent, step: float, stamp_ns: int) -> FrameResult:
    """An image tracked some way (in the keyframe's unit) ahead of a keyframe."""
    T_kf_cam = sim3.identity()
    T_kf_cam[2, 3] = step
    return FrameResult(stamp_ns, TrackingStatus.TRACKED,
                       T_world_cam=sim3.rigid_part(event.T_world_kf @ T_kf_cam),
                       reference_id=event.keyframe_id, T_kf_cam=T_kf_cam)


def unlike(event: KeyframeEvent, keyframe_id: int, edges_from: int) -> KeyframeEvent:
    """A keyframe more, an edge behind another one."""
    edge = dataclasses.replace(event.edges[0], a=edges_from, b=keyframe_id)
    return dataclasses.replace(event, keyframe_id=keyframe_id, edges=(edge,),
                               stamp_ns=event.stamp_ns + 10 ** 9 * keyframe_id)


def stamps_of(results: Iterable[FrameResult]) -> list[int]:
    return [r.stamp_ns for r in results if r.status is TrackingStatus.TRACKED]
