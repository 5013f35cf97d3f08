"""What was heard on the topics as a run with results: poses, keyframes, map and figures."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Mapping

import numpy as np
from torch import Tensor

from msg_adapters import clouds, frames, keyframes, poses
from msg_adapters.stamps import stamp_ns

from ...evaluation.delivery import Delivery, Traffic
from ...evaluation.received_run import ReceivedRun
from ...evaluation.run_result import PlacedKeyframe, stamped
from ...geometry import sim3
from ...types import Cloud, FrameReport, FrameResult, StampedPoses, TrackingStatus
from .collector import Heard, Topic
from .overview import LOOP_CLOSURE, newest_status

_T_OPTICAL_ZUP = poses.T_ZUP_OPTICAL.mT
_NO_CLOUD = Cloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8))


@dataclass(frozen=True)
class Playback:
    """What was played. published_ns: time.monotonic_ns of each image, by its stamp.

    images: how many were published; stamps may repeat.
    """

    published_ns: Mapping[int, int]
    images: int
    interrupted: bool


def received_run(topics: Mapping[str, Topic], playback: Playback) -> ReceivedRun:
    """Everything that was heard until now; the last session's map counts."""
    rows = FrameRows(topics['frame'])
    results, path = rows.results, _path(topics['path'])
    first_ns = min(playback.published_ns.values(), default=0)
    stage_s: defaultdict[str, float] = defaultdict(float)
    for result in results:
        for name, seconds in result.stage_s.items():
            stage_s[name] += seconds
    return ReceivedRun(
        results=results, unreadable=(), offered=playback.images,
        wall_s=max(rows.last_arrival_ns - first_ns, 0) / 1e9, stage_s=dict(stage_s),
        keyframes=_keyframes(topics, rows.session_id, path), map_cloud=_map(topics['map']),
        rotation_only_inferences=None, interrupted=playback.interrupted,
        path=stamped(sorted(path.items(), key=lambda item: item[0])),
        reported=_reported(topics['pose']),
        placed_late=len(rows.late),
        loops_closed=int(newest_status(topics, LOOP_CLOSURE).values.get('loops', 0)),
        travelled=_delivery(topics, playback, rows))


class FrameRows:
    """The rows of ``frame``: what was said about each image, perhaps more than once."""

    def __init__(self, topic: Topic) -> None:
        heard = topic.heard
        self.last_arrival_ns = heard[-1].arrival_ns if heard else 0
        self._reports: list[FrameReport] = [frames.frame_report(topic.read(h)) for h in heard]

    @cached_property
    def session_id(self) -> int | None:
        """Of the newest run of the frontend; None where nothing was heard."""
        return self._reports[-1].session_id if self._reports else None

    @cached_property
    def results(self) -> tuple[FrameResult, ...]:
        """One for every image, in time order; the later word counts.

        Keyframe ids mean nothing beyond their session: of earlier ones no pose counts.
        """
        merged: dict[int, FrameResult] = {}
        for report in self._reports:
            result = report.result
            if report.session_id != self.session_id:
                result = replace(result, reference_id=None, T_kf_cam=None)
            before = merged.get(result.stamp_ns)
            merged[result.stamp_ns] = result if before is None else _later(before, result)
        return tuple(merged[stamp] for stamp in sorted(merged))

    @cached_property
    def late(self) -> frozenset[int]:
        """Stamps of images that had no pose at first and one later."""
        waited = {report.result.stamp_ns for report in self._reports
                  if report.result.status is TrackingStatus.INITIALISING}
        return frozenset(r.stamp_ns for r in self.results
                         if r.stamp_ns in waited and r.status is TrackingStatus.TRACKED)


def _later(before: FrameResult, after: FrameResult) -> FrameResult:
    """The later result with what the image cost in all: a stage is told when it is over.

    A skipped one is another image with the same stamp.
    """
    if after.status is TrackingStatus.SKIPPED:
        return before
    names = dict.fromkeys((*before.stage_s, *after.stage_s))
    return replace(
        after, inferences=max(before.inferences, after.inferences),
        stage_s={name: max(before.stage_s.get(name, 0.0), after.stage_s.get(name, 0.0))
                 for name in names},
        window=after.window or before.window,
        kappa=before.kappa if after.kappa is None else after.kappa)


def _keyframes(topics: Mapping[str, Topic], session_id: int | None,
               path: Mapping[int, Tensor]) -> tuple[PlacedKeyframe, ...]:
    """Where each keyframe was said to be last; path: T_world_cam of images, by stamp."""
    told = _told_by_frontend(topics['keyframe'], session_id)
    message = topics['keyframe_poses'].read_newest()
    received = None if message is None else keyframes.correction(message)
    if received is None or received.session_id != session_id:
        return tuple(told[keyframe_id] for keyframe_id in sorted(told))
    pieces = received.corrected.pieces
    joined = {told[k].piece_id: piece for k, piece in pieces.items() if k in told}
    placed = {k: _as_corrected(keyframe, joined, path) for k, keyframe in told.items()}
    placed |= {p.keyframe_id: PlacedKeyframe(p.keyframe_id, pieces[p.keyframe_id],
                                             received.stamps_ns[p.keyframe_id], p.T_world_kf)
               for p in received.corrected.poses}
    return tuple(placed[keyframe_id] for keyframe_id in sorted(placed))


def _as_corrected(keyframe: PlacedKeyframe, joined: Mapping[int, int],
                  path: Mapping[int, Tensor]) -> PlacedKeyframe:
    """A keyframe that the correction lacks; it may be told of in the world before it.

    Loop closure's word about its image is newer. joined: what became of each map piece.
    """
    T_world_kf = keyframe.T_world_kf
    if keyframe.stamp_ns in path:
        T_world_kf = sim3.with_scale(path[keyframe.stamp_ns], sim3.scale_of(T_world_kf))
    return replace(keyframe, T_world_kf=T_world_kf,
                   piece_id=joined.get(keyframe.piece_id, keyframe.piece_id))


def _told_by_frontend(topic: Topic, session_id: int | None) -> dict[int, PlacedKeyframe]:
    """By id: the newest of its own message and of those that moved it."""
    placed: dict[int, PlacedKeyframe] = {}
    for heard in topic.heard:
        table = keyframes.keyframe_placement(topic.read(heard))
        if table.session_id != session_id:
            continue
        new, *moved = table.poses
        placed[new.keyframe_id] = PlacedKeyframe(new.keyframe_id, table.piece_id, table.stamp_ns,
                                                 new.T_world_kf)
        for pose in moved:
            if pose.keyframe_id in placed:
                placed[pose.keyframe_id] = replace(placed[pose.keyframe_id],
                                                   T_world_kf=pose.T_world_kf)
    return placed


def _camera_pose(T_zup_cam: Tensor) -> Tensor:
    """T_world_cam [4,4], rigid, in a world with the axes of the first camera."""
    return _T_OPTICAL_ZUP @ T_zup_cam


def _path(topic: Topic) -> dict[int, Tensor]:
    """T_world_cam by stamp."""
    message = topic.read_newest()
    return {} if message is None else {
        stamp_ns(pose.header.stamp): _camera_pose(poses.matrix(pose.pose))
        for pose in message.poses}


def _reported(topic: Topic) -> StampedPoses:
    """The first pose of each image."""
    placed: dict[int, Tensor] = {}
    for heard in topic.heard:
        message = topic.read(heard)
        placed.setdefault(stamp_ns(message.header.stamp),
                          _camera_pose(poses.matrix(message.pose)))
    return stamped(sorted(placed.items(), key=lambda item: item[0]))


def _map(topic: Topic) -> Cloud:
    message = topic.read_newest()
    if message is None:
        return _NO_CLOUD
    cloud = clouds.cloud_from_msg(message)
    return Cloud(cloud.points @ poses.T_ZUP_OPTICAL[:3, :3].float().numpy(), cloud.colours)


def _delivery(topics: Mapping[str, Topic], playback: Playback, rows: FrameRows) -> Delivery:
    """Latency is from the publication of an image to the first arrival of its pose."""
    topic = topics['pose']
    arrived: dict[int, Heard] = {}
    for heard in topic.heard:
        arrived.setdefault(stamp_ns(topic.read(heard).header.stamp), heard)
    latencies = [(heard.arrival_ns - playback.published_ns[stamp]) / 1e6
                 for stamp, heard in arrived.items()
                 if stamp in playback.published_ns and stamp not in rows.late]
    return Delivery(np.array(latencies), len(arrived.keys() & rows.late),
                    {name: Traffic(topic.messages, topic.size_bytes)
                     for name, topic in topics.items()})
