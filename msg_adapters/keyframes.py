"""The keyframe event and its correction: the tables that the two nodes exchange.

This is a public format. All numbers are little-endian; ids count from 0 and are unique within one
``session_id``, a random number of each run of the frontend. Columns may stand in any order, and a
reader passes over columns that it does not know.

``keyframe``: unorganised PointCloud2, frame_id the map frame. Row 0 is the keyframe: a new one,
one that is sent again, or one whose cloud became better by more observations.

    kind           UINT8       0 the keyframe, 1 an older one that moved, 2 an edge
    keyframe_id    UINT32      of the keyframe; of an edge its end a
    other_id       UINT32      of an edge its end b; else 0
    x y z          FLOAT32     kind 0, 1: translation of T_map_keyframe, which leads from the
                               keyframe's optical frame (x right, y down, z forward) to the z-up
                               map; kind 2: of T_a_b, between two optical frames
    qx qy qz qw    FLOAT32     its rotation
    scale          FLOAT32     its scale, p_map = scale R p + t: every keyframe has its own unit
    sigma          FLOAT32[7]  kind 2: standard deviations of T_a_b, perturbed on the left:
                               translation [units of a], rotation [rad], log-scale; else 0
    fx fy cx cy    FLOAT32     kind 0: intrinsics [px], pixel centres at integers; else 0
    descriptor     FLOAT32[D]  kind 0: of unit length, for retrieval by cosine similarity; else 0
    observations   UINT32      kind 0: inferences that its cloud is the mean of; else 0
    piece_id       UINT32      kind 0, 2: connected part of the map; kind 1: 0
    session_id     UINT32
    stamp_sec      INT32       of the new keyframe's image, as in the header
    stamp_nanosec  UINT32

``keyframe_cloud``: organised PointCloud2 [H,W] of the same stamp, frame_id the camera's optical
frame, one point per pixel: x y z (scale applied: in the map's unit), rgb, confidence, all FLOAT32.
rgb has the bits 0x00RRGGBB and is the image itself; confidence is above 1, and near 1 where
nothing is known.

``keyframe_poses``: unorganised, frame_id the map frame: all corrected poses, one row per keyframe.

    x y z qx qy qz qw scale  FLOAT32  T_map_keyframe as above
    keyframe_id  piece_id    UINT32
    version                  UINT32   counts the corrections of a session up from 1
    session_id               UINT32
    stamp_sec  stamp_nanosec INT32, UINT32  of the keyframe's image
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Mapping

import numpy as np
import torch
from sensor_msgs.msg import PointCloud2
from torch import Tensor

from aim_slam_ros.types import CorrectedKeyframes, KeyframeEvent, KeyframePose, PoseEdge

from .clouds import packed, points_of, set_points, unpacked
from .errors import MessageError
from .pose_columns import QUATERNION, TRANSLATION, poses_of, set_poses, z_forward, z_up
from .stamps import NS_PER_S, stamp_ns
from .tables import rows_of, table_msg

NEW, MOVED, EDGE = 0, 1, 2
_POSE = [(name, '<f4') for name in (*TRANSLATION, *QUATERNION, 'scale')]
_STAMP = [('session_id', '<u4'), ('stamp_sec', '<i4'), ('stamp_nanosec', '<u4')]
_INTRINSICS = ('fx', 'fy', 'cx', 'cy')
_KEYFRAME = [*_POSE, ('kind', 'u1'), ('keyframe_id', '<u4'), ('other_id', '<u4'),
             ('piece_id', '<u4'), ('observations', '<u4'), *_STAMP,
             *((name, '<f4') for name in _INTRINSICS), ('sigma', '<f4', (7,))]
_DESCRIPTOR = np.dtype([('descriptor', '<f4')])   # of any length
_CLOUD = np.dtype([(name, '<f4') for name in ('x', 'y', 'z', 'rgb', 'confidence')])
_CORRECTION = np.dtype([*_POSE, ('keyframe_id', '<u4'), ('piece_id', '<u4'), ('version', '<u4'),
                        *_STAMP])


@dataclass(frozen=True)
class KeyframeMessages:
    """The two messages of one event; they have the same stamp."""

    table: PointCloud2
    cloud: PointCloud2


@dataclass(frozen=True)
class ReceivedKeyframe:
    """An event and the session of the frontend that it comes from."""

    session_id: int
    event: KeyframeEvent


@dataclass(frozen=True)
class ReceivedPlacement:
    """What the table alone says: the poses of the new keyframe, first, and of those that moved."""

    session_id: int
    piece_id: int
    stamp_ns: int
    poses: tuple[KeyframePose, ...]


@dataclass(frozen=True)
class ReceivedCorrection:
    """A correction, the session its keyframes belong to, and their stamps by keyframe id."""

    session_id: int
    corrected: CorrectedKeyframes
    stamps_ns: Mapping[int, int]


def keyframe_messages(event: KeyframeEvent, session_id: int, camera_frame: str,
                      map_frame: str) -> KeyframeMessages:
    """Raises MessageError for a pose that is no transform."""
    descriptor = event.descriptor.detach().cpu().numpy()
    poses = [event.T_world_kf, *(pose.T_world_kf for pose in event.moved)]
    first_edge = len(poses)
    columns: list[Any] = [*_KEYFRAME, ('descriptor', '<f4', descriptor.shape)]
    rows = np.zeros(first_edge + len(event.edges), columns)
    set_poses(rows, torch.cat([z_up(torch.stack(poses)),
                               *(edge.T_a_b[None] for edge in event.edges)]))
    rows['kind'][1:first_edge], rows['kind'][first_edge:] = MOVED, EDGE
    rows['keyframe_id'] = [event.keyframe_id, *(pose.keyframe_id for pose in event.moved),
                           *(edge.a for edge in event.edges)]
    rows['session_id'] = session_id
    rows['stamp_sec'], rows['stamp_nanosec'] = divmod(event.stamp_ns, NS_PER_S)
    rows['piece_id'][0] = rows['piece_id'][first_edge:] = event.piece_id
    for row, edge in zip(rows[first_edge:], event.edges):
        row['other_id'], row['sigma'] = edge.b, edge.sigma.numpy()
    rows['observations'][0] = event.observations
    K = event.K
    for name, value in zip(_INTRINSICS, (K[0, 0], K[1, 1], K[0, 2], K[1, 2])):
        rows[name][0] = float(value)
    rows['descriptor'][0] = descriptor
    return KeyframeMessages(table_msg(rows, event.stamp_ns, map_frame),
                            _cloud(event, rows['scale'][0], camera_frame))


def _cloud(event: KeyframeEvent, scale: float, camera_frame: str) -> PointCloud2:
    rows = np.empty(event.image.shape[:2], _CLOUD)
    set_points(rows, event.points_cam.detach().cpu().numpy(), scale)
    rows['rgb'] = packed(event.image)
    rows['confidence'] = event.confidence.detach().cpu().numpy()
    return table_msg(rows, event.stamp_ns, camera_frame)


def keyframe_event(table: Any, cloud: Any) -> ReceivedKeyframe:
    """The inverse of keyframe_messages, up to float32.

    Raises MessageError for messages that are not as this file describes them, or that do not
    belong together.
    """
    rows = _keyframe_rows(table)
    pixels = rows_of(cloud, _CLOUD)
    new = rows[0]
    stamp = int(new['stamp_sec']) * NS_PER_S + int(new['stamp_nanosec'])
    if not stamp == stamp_ns(table.header.stamp) == stamp_ns(cloud.header.stamp):
        raise MessageError(
            f'a keyframe of stamp {stamp} has a table of {stamp_ns(table.header.stamp)} and a '
            f'cloud of {stamp_ns(cloud.header.stamp)}: pair them by equal stamps')
    if min(pixels.shape) < 2:
        raise MessageError(f"a keyframe's cloud has {pixels.shape[0]} rows of {pixels.shape[1]} "
                           'points: it must be organised, one point for each pixel of the image')
    relative = rows['kind'] == EDGE
    T_map_kf = poses_of(rows[~relative], "a keyframe's pose")
    T_world_kf = z_forward(T_map_kf)
    moved = tuple(KeyframePose(int(row['keyframe_id']), T)
                  for row, T in zip(rows[~relative][1:], T_world_kf[1:]))
    event = KeyframeEvent(
        keyframe_id=int(new['keyframe_id']), piece_id=int(new['piece_id']), stamp_ns=stamp,
        image=unpacked(pixels['rgb']), K=_intrinsics(new),
        points_cam=torch.from_numpy(points_of(pixels, float(new['scale']))),
        confidence=torch.from_numpy(pixels['confidence'].astype(np.float32)),
        T_world_kf=T_world_kf[0], descriptor=_descriptor(new), edges=_edges(rows[relative]),
        moved=moved, observations=max(1, int(new['observations'])))
    return ReceivedKeyframe(int(new['session_id']), event)


def keyframe_placement(table: Any) -> ReceivedPlacement:
    """For those who do without the cloud; raises MessageError."""
    rows = _keyframe_rows(table)
    rows = rows[rows['kind'] != EDGE]
    T_world_kf = z_forward(poses_of(rows, "a keyframe's pose"))
    new = rows[0]
    return ReceivedPlacement(
        int(new['session_id']), int(new['piece_id']),
        int(new['stamp_sec']) * NS_PER_S + int(new['stamp_nanosec']),
        tuple(KeyframePose(int(row['keyframe_id']), T) for row, T in zip(rows, T_world_kf)))


def _keyframe_rows(table: Any) -> np.ndarray:
    rows = rows_of(table, np.dtype(_KEYFRAME), _DESCRIPTOR).reshape(-1)
    if not len(rows):
        raise MessageError("a keyframe's table has no rows")
    kinds = rows['kind']
    if kinds[0] != NEW or (kinds[1:] == NEW).any() or (kinds > EDGE).any():
        raise MessageError(f"the rows of a keyframe's table are of kinds {kinds[:20].tolist()}: "
                           'the first must be 0 (new keyframe), the others 1 (moved) or 2 (edge)')
    if (rows['session_id'] != rows['session_id'][0]).any():
        raise MessageError("the rows of a keyframe's table come from several sessions")
    return rows


def _intrinsics(row: np.ndarray) -> Tensor:
    fx, fy, cx, cy = (float(row[name]) for name in _INTRINSICS)
    if not (np.isfinite([fx, fy, cx, cy]).all() and fx > 0 and fy > 0):
        raise MessageError(f'a keyframe has the intrinsics fx {fx:g} fy {fy:g} cx {cx:g} '
                           f'cy {cy:g}: they must be finite, and focal lengths positive')
    return torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], dtype=torch.float64)


def _descriptor(row: np.ndarray) -> Tensor:
    descriptor = np.atleast_1d(row['descriptor']).astype(np.float32)
    if not np.isfinite(descriptor).all():
        raise MessageError("a keyframe's descriptor holds values that are not finite")
    return torch.from_numpy(descriptor)


def _edges(rows: np.ndarray) -> tuple[PoseEdge, ...]:
    sigma = rows['sigma'].astype(np.float64)
    if not (np.isfinite(sigma).all() and (sigma > 0).all()):
        raise MessageError("an edge's sigma must be finite and positive")
    if (rows['keyframe_id'] == rows['other_id']).any():
        raise MessageError('an edge joins a keyframe to itself')
    T_a_b = poses_of(rows, 'an edge')
    return tuple(PoseEdge(int(row['keyframe_id']), int(row['other_id']), T, torch.from_numpy(s))
                 for row, T, s in zip(rows, T_a_b, sigma))


def correction_message(corrected: CorrectedKeyframes, stamps_ns: Mapping[int, int],
                       session_id: int, map_frame: str, stamp_ns: int) -> PointCloud2:
    """stamps_ns: of every keyframe, by its id; stamp_ns: of the message.

    A keyframe without a piece is in piece 0. Raises MessageError for no keyframes, one without a
    stamp, or a pose that is no transform.
    """
    ids = [pose.keyframe_id for pose in corrected.poses]
    missing = [i for i in ids if i not in stamps_ns]
    if missing or not ids:
        raise MessageError(f'no stamp is known of keyframes {missing[:10]} of a correction'
                           if missing else 'a correction needs at least one keyframe')
    rows = np.zeros(len(ids), _CORRECTION)
    set_poses(rows, z_up(torch.stack([pose.T_world_kf for pose in corrected.poses])))
    rows['keyframe_id'] = ids
    rows['piece_id'] = [corrected.pieces.get(i, 0) for i in ids]
    rows['version'], rows['session_id'] = corrected.version, session_id
    stamps = np.array([stamps_ns[i] for i in ids], np.int64)
    rows['stamp_sec'], rows['stamp_nanosec'] = np.divmod(stamps, NS_PER_S)
    return table_msg(rows, stamp_ns, map_frame)


def correction(msg: Any) -> ReceivedCorrection:
    """The inverse of correction_message, up to float32; raises MessageError."""
    rows = rows_of(msg, _CORRECTION).reshape(-1)
    if not len(rows):
        raise MessageError('a correction has no rows')
    for name in ('version', 'session_id'):
        if (rows[name] != rows[name][0]).any():
            raise MessageError(f'the rows of a correction differ in their {name}')
    ids = rows['keyframe_id'].tolist()
    if len(set(ids)) < len(ids):
        raise MessageError('a correction names a keyframe twice')
    T_world_kf = z_forward(poses_of(rows, 'a corrected pose'))
    stamps = rows['stamp_sec'].astype(np.int64) * NS_PER_S + rows['stamp_nanosec']
    corrected = CorrectedKeyframes(
        int(rows['version'][0]), tuple(KeyframePose(i, T) for i, T in zip(ids, T_world_kf)),
        dict(zip(ids, rows['piece_id'].tolist())))
    return ReceivedCorrection(int(rows['session_id'][0]), corrected,
                              dict(zip(ids, stamps.tolist())))
