"""The corrected keyframe poses over real serialisation."""

from __future__ import annotations

from typing import Any, Callable

import numpy as np
import pytest
import torch
from sensor_msgs.msg import PointCloud2
from torch import Tensor
from wire import as_in_bag, over_wire

from aim_slam_ros.geometry import sim3
from aim_slam_ros.types import CorrectedKeyframes, KeyframePose
from msg_adapters.clouds import cloud_msg
from msg_adapters.errors import MessageError
from msg_adapters.keyframes import correction, correction_message
from msg_adapters.stamps import stamp_ns
from msg_adapters.tables import rows_of, table_msg

STAMP = 1_305_031_102_175_304_001
SESSION = 4_000_000_007   # above 2^31: an unsigned number
PIECES = {3: 0, 5: 0, 9: 2}
STAMPS = {3: STAMP, 5: STAMP + 1, 9: STAMP + 10**10}


def _pose(seed: int) -> Tensor:
    return sim3.exp(torch.randn(7, dtype=torch.float64,
                                generator=torch.Generator().manual_seed(seed)))


def _edited(msg: PointCloud2, column: str, row: int, value: Any) -> PointCloud2:
    rows_of(msg, np.dtype([]))[0][column][row] = value
    return msg


def _corrected(pieces: dict[int, int] | None = None) -> CorrectedKeyframes:
    return CorrectedKeyframes(6, tuple(KeyframePose(i, _pose(i)) for i in STAMPS),
                              PIECES if pieces is None else pieces)


def _correction(pieces: dict[int, int] | None = None) -> PointCloud2:
    return correction_message(_corrected(pieces), STAMPS, SESSION, 'map', STAMP + 5)


@pytest.mark.parametrize('read', [over_wire, as_in_bag])
def test_round_trip_of_a_correction(read: Callable[[PointCloud2], Any]) -> None:
    msg = read(_correction())
    assert (stamp_ns(msg.header.stamp), msg.header.frame_id) == (STAMP + 5, 'map')
    found = correction(msg)
    assert (found.session_id, found.corrected.version) == (SESSION, 6)
    assert (dict(found.stamps_ns), dict(found.corrected.pieces)) == (STAMPS, PIECES)
    assert [pose.keyframe_id for pose in found.corrected.poses] == list(STAMPS)
    for pose in found.corrected.poses:
        # float32 has 24 bits, 6e-8 of values up to 4; a quaternion's error doubles in its matrix.
        torch.testing.assert_close(pose.T_world_kf, _pose(pose.keyframe_id), atol=4e-6, rtol=1e-6)


def test_a_keyframe_without_a_piece_is_in_the_first() -> None:
    assert correction(_correction({9: 2})).corrected.pieces == {3: 0, 5: 0, 9: 2}


BAD_CORRECTIONS: dict[str, tuple[PointCloud2, str]] = {
    'a cloud': (cloud_msg(np.zeros((2, 3)), np.zeros((2, 3), np.uint8), 0, 'map'),
                "lacks the column 'qx'"),
    'no rows': (table_msg(rows_of(_correction(), np.dtype([]))[0][:0], 0, 'map'), 'has no rows'),
    'two versions': (_edited(_correction(), 'version', 1, 7), 'differ in their version'),
    'two sessions': (_edited(_correction(), 'session_id', 2, 7), 'differ in their session_id'),
    'a keyframe twice': (_edited(_correction(), 'keyframe_id', 1, 3), 'names a keyframe twice'),
    'NaN': (_edited(_correction(), 'qw', 0, np.nan), 'a corrected pose holds values'),
    'no scale': (_edited(_correction(), 'scale', 2, 0), 'scale of 0'),
}


@pytest.mark.parametrize('case', BAD_CORRECTIONS)
def test_a_bad_correction_is_named(case: str) -> None:
    msg, text = BAD_CORRECTIONS[case]
    with pytest.raises(MessageError, match=text):
        correction(over_wire(msg))


def test_what_cannot_be_sent_as_a_correction() -> None:
    with pytest.raises(MessageError, match=r'no stamp is known of keyframes \[9\]'):
        correction_message(_corrected(), {3: 0, 5: 0}, SESSION, 'map', 0)
    with pytest.raises(MessageError, match='at least one keyframe'):
        correction_message(CorrectedKeyframes(1, ()), {}, SESSION, 'map', 0)


def test_a_correction_of_a_long_run_is_z_up() -> None:
    """All rows at once: ten thousand keyframes one behind the other, along x of the map."""
    count = 10_000
    T = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    T[:, 2, 3] = torch.arange(count)
    poses = tuple(KeyframePose(i, T_world_kf) for i, T_world_kf in enumerate(T))
    stamps = {i: STAMP + i for i in range(count)}
    corrected = CorrectedKeyframes(1, poses)
    msg = over_wire(correction_message(corrected, stamps, SESSION, 'map', STAMP))
    rows = rows_of(msg, np.dtype([]))[0]
    np.testing.assert_array_equal(rows['x'], np.arange(count))
    assert not rows['y'].any() and not rows['z'].any()
    assert correction(msg).stamps_ns == stamps
