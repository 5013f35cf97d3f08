"""The row of every image over real serialisation."""

from __future__ import annotations

import dataclasses
from typing import Any, Callable

import numpy as np
import pytest
import torch
from sensor_msgs.msg import PointCloud2, PointField
from wire import as_in_bag, over_wire

from aim_slam_ros.geometry import sim3
from aim_slam_ros.types import FrameReport, FrameResult, TrackingStatus
from msg_adapters.errors import MessageError
from msg_adapters.frames import frame_message, frame_report
from msg_adapters.stamps import stamp_ns
from msg_adapters.tables import rows_of, table_msg

STAMP = 1_305_031_102_175_304_001
FLOAT32 = 1e-6   # 24 bits are 6e-8 of a value; a quaternion's error is doubled in its matrix


def _pose(seed: int) -> torch.Tensor:
    xi = torch.randn(7, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return sim3.rigid_part(sim3.exp(xi))


TRACKED = FrameReport(
    session_id=4_000_000_007, dropped=3, T_odom_cam=_pose(1),
    result=FrameResult(
        stamp_ns=STAMP, status=TrackingStatus.TRACKED, reference_id=4, T_kf_cam=_pose(2),
        piece_id=1, window=(4, 2, 3), kappa=0.75, inferences=2, matched_fraction=0.5,
        stage_s={'follow': 0.03125, 'infer': 0.5}))


def _replaced(**changes: Any) -> FrameReport:
    return dataclasses.replace(TRACKED, result=dataclasses.replace(TRACKED.result, **changes))


REPORTS = {
    'tracked': TRACKED,
    'no keyframe yet': FrameReport(7, FrameResult(0, TrackingStatus.INITIALISING)),
    'lost': FrameReport(0, FrameResult(STAMP, TrackingStatus.LOST, piece_id=2), dropped=9),
    'skipped': FrameReport(1, FrameResult(STAMP, TrackingStatus.SKIPPED)),
    'keyframe 0': _replaced(reference_id=0, window=(0,), stage_s={}),
    'a wide window': _replaced(window=tuple(range(20))),
    'no solve': _replaced(kappa=None, window=()),
}


def _assert_same_pose(found: torch.Tensor | None, expected: torch.Tensor | None) -> None:
    assert (found is None) == (expected is None)
    if found is not None and expected is not None:
        torch.testing.assert_close(found, expected, atol=FLOAT32 * 4, rtol=FLOAT32)


@pytest.mark.parametrize('read', [over_wire, as_in_bag])
@pytest.mark.parametrize('case', REPORTS)
def test_round_trip(case: str, read: Callable[[PointCloud2], Any]) -> None:
    report = REPORTS[case]
    found = frame_report(read(frame_message(report, 'odom')))
    _assert_same_pose(found.T_odom_cam, report.T_odom_cam)
    _assert_same_pose(found.result.T_kf_cam, report.result.T_kf_cam)
    # Everything else is a whole number or one that float32 holds exactly.
    assert (found.session_id, found.dropped) == (report.session_id, report.dropped)
    assert dataclasses.replace(found.result, T_kf_cam=None) == \
        dataclasses.replace(report.result, T_kf_cam=None)


def test_what_does_not_travel() -> None:
    found = frame_report(frame_message(_replaced(T_world_cam=_pose(3), reason='dark'), 'odom'))
    assert (found.result.T_world_cam, found.result.events, found.result.late,
            found.result.reason) == (None, (), (), '')


def test_the_row_is_stamped_as_the_image_and_z_up() -> None:
    T = sim3.from_parts(1.0, torch.eye(3), torch.tensor([1.0, 2.0, 3.0]))
    msg = over_wire(frame_message(dataclasses.replace(TRACKED, T_odom_cam=T), 'odom'))
    assert (stamp_ns(msg.header.stamp), msg.header.frame_id) == (STAMP, 'odom')
    row = rows_of(msg, np.dtype([]))[0, 0]
    assert [float(row[name]) for name in 'xyz'] == [3, -1, -2]


def _edited(column: str, value: Any) -> PointCloud2:
    msg = frame_message(TRACKED, 'odom')
    rows_of(msg, np.dtype([]))[column] = value
    return msg


def _two_rows() -> PointCloud2:
    rows = rows_of(frame_message(TRACKED, 'odom'), np.dtype([]))[0]
    return table_msg(np.concatenate([rows, rows]), STAMP, 'odom')


def _zero_quaternion() -> PointCloud2:
    msg = frame_message(TRACKED, 'odom')
    for name in ('qx', 'qy', 'qz', 'qw'):
        rows_of(msg, np.dtype([]))[name] = 0.0
    return msg


BAD_FRAMES: dict[str, tuple[PointCloud2, str]] = {
    'an empty message': (PointCloud2(), 'point_step is wrong'),
    'two rows': (_two_rows(), 'has 2 rows instead of 1'),
    'unknown status': (_edited('status', 4), 'unknown status 4'),
    'a pose half NaN': (_edited('qx', np.nan), "a frame's pose holds values"),
    'an infinite pose in the keyframe': (_edited('kf_x', np.inf), 'in its keyframe holds values'),
    'zero quaternion': (_zero_quaternion(), 'quaternion of length 0'),
    'a window too long': (_edited('window_count', 9), 'counts 9 keyframes'),
    'a negative id': (_edited('window', -1), 'counts 3 keyframes'),
}


@pytest.mark.parametrize('case', BAD_FRAMES)
def test_a_bad_row_is_named(case: str) -> None:
    msg, text = BAD_FRAMES[case]
    with pytest.raises(MessageError, match=text):
        frame_report(over_wire(msg))


def test_every_column_but_the_stages_is_needed_with_its_type() -> None:
    for index, field in enumerate(frame_message(TRACKED, 'odom').fields):
        if field.name.startswith('stage_'):
            continue
        msg = frame_message(TRACKED, 'odom')
        msg.fields[index].datatype = PointField.INT8
        with pytest.raises(MessageError, match=f"column '{field.name}' of a table is INT8"):
            frame_report(msg)
        del msg.fields[index]
        with pytest.raises(MessageError, match=f"lacks the column '{field.name}'"):
            frame_report(msg)


def test_stages_of_other_types_are_passed_over() -> None:
    msg = frame_message(TRACKED, 'odom')
    next(f for f in msg.fields if f.name == 'stage_infer').datatype = PointField.UINT32
    assert frame_report(over_wire(msg)).result.stage_s == {'follow': 0.03125}


def test_random_bytes_give_a_report_or_a_message_error() -> None:
    rng = np.random.default_rng(0)
    for _ in range(300):
        msg = frame_message(TRACKED, 'odom')
        data = np.frombuffer(msg.data, np.uint8)
        data[rng.integers(0, len(data), 3)] = rng.integers(0, 256, 3)
        try:
            frame_report(msg)
        except MessageError:
            continue
