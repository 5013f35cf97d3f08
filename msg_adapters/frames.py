"""What became of one image: the row that the frontend publishes for each.

This is a public format: ``frame``, a PointCloud2 with one row, stamped as the image, frame_id the
odom frame. Columns may stand in any order, and a reader passes over columns it does not know.

    x y z qx qy qz qw  FLOAT32  T_odom_cam, from the camera's optical frame (x right, y down, z
                                forward) to the z-up odom frame; NaN where there is no pose
    kf_x kf_y kf_z kf_qx kf_qy kf_qz kf_qw  FLOAT32  T_keyframe_cam, rigid, in the unit of the
                                reference keyframe; NaN where there is none
    reference_id       INT32    keyframe that the image was tracked against; -1 without
    status             UINT8    0 initialising, 1 tracked, 2 lost, 3 skipped
    piece_id           UINT32   connected part of the map
    session_id         UINT32   of the run of the frontend
    stamp_sec          INT32    of the image, as in the header
    stamp_nanosec      UINT32
    kappa              FLOAT32  reduced chi-square of the solve; NaN without
    matched_fraction   FLOAT32
    inferences         UINT32   model calls made for the image
    window_count       UINT32   so many entries of ``window`` are keyframe ids of the inference
    window             INT32[8 or more]  the others are -1
    dropped            UINT32   images that found the frontend busy, since it started
    stage_<name>       FLOAT32  seconds spent in each stage; which there are varies
"""

from __future__ import annotations

from typing import Any

import numpy as np
from sensor_msgs.msg import PointCloud2
from torch import Tensor

from aim_slam_ros.types import FrameReport, FrameResult, TrackingStatus

from .errors import MessageError
from .pose_columns import RIGID, poses_of, set_poses, z_forward, z_up
from .stamps import NS_PER_S
from .tables import rows_of, table_msg

_KEYFRAME = 'kf_'
_STAGE = 'stage_'
_WINDOW = 8
_STATUSES = tuple(TrackingStatus)
_COLUMNS = [*((name, '<f4') for name in RIGID),
            *((_KEYFRAME + name, '<f4') for name in RIGID),
            ('reference_id', '<i4'), ('status', 'u1'), ('piece_id', '<u4'), ('session_id', '<u4'),
            ('stamp_sec', '<i4'), ('stamp_nanosec', '<u4'), ('kappa', '<f4'),
            ('matched_fraction', '<f4'), ('inferences', '<u4'), ('window_count', '<u4'),
            ('dropped', '<u4')]


def frame_message(report: FrameReport, odom_frame: str) -> PointCloud2:
    """Raises MessageError for a pose that is no transform."""
    result = report.result
    columns: list[Any] = [*_COLUMNS, ('window', '<i4', (max(_WINDOW, len(result.window)),)),
                          *((_STAGE + name, '<f4') for name in result.stage_s)]
    rows = np.zeros(1, columns)
    _set_pose(rows, '', None if report.T_odom_cam is None else z_up(report.T_odom_cam))
    _set_pose(rows, _KEYFRAME, result.T_kf_cam)
    rows['reference_id'] = -1 if result.reference_id is None else result.reference_id
    rows['status'] = _STATUSES.index(result.status)
    rows['piece_id'], rows['session_id'] = result.piece_id, report.session_id
    rows['stamp_sec'], rows['stamp_nanosec'] = divmod(result.stamp_ns, NS_PER_S)
    rows['kappa'] = np.nan if result.kappa is None else result.kappa
    rows['matched_fraction'] = result.matched_fraction
    rows['inferences'], rows['dropped'] = result.inferences, report.dropped
    rows['window_count'], rows['window'] = len(result.window), -1
    rows['window'][0, :len(result.window)] = result.window
    for name, seconds in result.stage_s.items():
        rows[_STAGE + name] = seconds
    return table_msg(rows, result.stamp_ns, odom_frame)


def _set_pose(rows: np.ndarray, prefix: str, T: Tensor | None) -> None:
    if T is not None:
        set_poses(rows, T[None], prefix)
        return
    for name in RIGID:
        rows[prefix + name] = np.nan


def frame_report(msg: Any) -> FrameReport:
    """The inverse of frame_message, up to float32; raises MessageError."""
    rows = rows_of(msg, np.dtype(_COLUMNS), np.dtype([('window', '<i4')])).reshape(-1)
    if len(rows) != 1:
        raise MessageError(f'a frame table has {len(rows)} rows instead of 1')
    row = rows[0]
    if row['status'] >= len(_STATUSES):
        raise MessageError(f'a frame table has the unknown status {row["status"]}: do both nodes '
                           'have the same version?')
    T_odom_cam = _pose_of(rows, '', "a frame's pose")
    stages = {name[len(_STAGE):]: float(row[name]) for name in rows.dtype.names or ()
              if name.startswith(_STAGE) and rows.dtype[name] == np.float32}
    result = FrameResult(
        stamp_ns=int(row['stamp_sec']) * NS_PER_S + int(row['stamp_nanosec']),
        status=_STATUSES[row['status']],
        reference_id=int(row['reference_id']) if row['reference_id'] >= 0 else None,
        T_kf_cam=_pose_of(rows, _KEYFRAME, "a frame's pose in its keyframe"),
        piece_id=int(row['piece_id']), window=_window(row),
        kappa=None if np.isnan(row['kappa']) else float(row['kappa']),
        inferences=int(row['inferences']), matched_fraction=float(row['matched_fraction']),
        stage_s=stages)
    return FrameReport(
        session_id=int(row['session_id']), result=result, dropped=int(row['dropped']),
        T_odom_cam=None if T_odom_cam is None else z_forward(T_odom_cam))


def _pose_of(rows: np.ndarray, prefix: str, what: str) -> Tensor | None:
    """None where all of its columns are NaN."""
    if all(np.isnan(rows[prefix + name][0]) for name in RIGID):
        return None
    return poses_of(rows, what, prefix)[0]


def _window(row: np.ndarray) -> tuple[int, ...]:
    ids = np.atleast_1d(row['window'])
    count = int(row['window_count'])
    if count > len(ids) or (ids[:count] < 0).any():
        raise MessageError(f'a frame table counts {count} keyframes in its window '
                           f'{ids.tolist()}')
    return tuple(ids[:count].tolist())
