"""Poses, stamps and frames over real serialisation."""

from __future__ import annotations

import math

import pytest
import torch
from geometry_msgs.msg import Pose
from torch import Tensor
from wire import over_wire

from aim_slam_ros.geometry import sim3
from msg_adapters.errors import MessageError
from msg_adapters.poses import (T_ZUP_OPTICAL, matrix, odometry, path, pose_msg, pose_stamped,
                                transform)
from msg_adapters.stamps import stamp_msg, stamp_ns

STAMP = 1_305_031_102_175_304_001
EXACT = 1e-12   # float64 all the way: rounding alone


def _transforms(count: int, scale: bool = False) -> Tensor:
    xi = torch.randn(count, 7, dtype=torch.float64,
                     generator=torch.Generator().manual_seed(1))
    return sim3.exp(xi) if scale else sim3.rigid_part(sim3.exp(xi))


def _half_turn(axis: int) -> Tensor:
    """Where a quaternion's real part is 0, and its sign not settled."""
    R = -torch.eye(3, dtype=torch.float64)
    R[axis, axis] = 1.0
    return sim3.from_parts(1.0, R, torch.tensor([1.0, -2.0, 3.0]))


@pytest.mark.parametrize('T', [*_transforms(5), sim3.identity(), *map(_half_turn, range(3))])
def test_round_trip_of_a_pose(T: Tensor) -> None:
    found = matrix(over_wire(pose_msg(T)))
    assert found.dtype == torch.float64
    torch.testing.assert_close(found, T, atol=EXACT, rtol=0)


def test_a_message_is_rigid() -> None:
    T = _transforms(1, scale=True)[0]
    torch.testing.assert_close(matrix(over_wire(pose_msg(T))), sim3.rigid_part(T),
                               atol=EXACT, rtol=0)


def test_headers_of_the_stamped_messages() -> None:
    T = _transforms(1)[0]
    stamped = over_wire(pose_stamped(T, STAMP, 'odom'))
    assert (stamp_ns(stamped.header.stamp), stamped.header.frame_id) == (STAMP, 'odom')
    odom = over_wire(odometry(T, STAMP, 'odom', 'camera'))
    assert (stamp_ns(odom.header.stamp), odom.header.frame_id) == (STAMP, 'odom')
    assert odom.child_frame_id == 'camera'
    torch.testing.assert_close(matrix(stamped.pose), T, atol=EXACT, rtol=0)
    torch.testing.assert_close(matrix(odom.pose.pose), T, atol=EXACT, rtol=0)


def test_a_tf_transform_says_the_same_as_the_pose() -> None:
    T = _transforms(1)[0]
    found = over_wire(transform(T, STAMP, 'odom', 'camera'))
    assert (found.header.frame_id, found.child_frame_id) == ('odom', 'camera')
    assert stamp_ns(found.header.stamp) == STAMP
    pose = Pose(orientation=found.transform.rotation)
    pose.position.x, pose.position.y, pose.position.z = (
        found.transform.translation.x, found.transform.translation.y,
        found.transform.translation.z)
    torch.testing.assert_close(matrix(pose), T, atol=EXACT, rtol=0)


def test_round_trip_of_a_path() -> None:
    Ts = _transforms(20)
    stamps = [STAMP + 33_333_333 * i for i in range(20)]
    for given in (Ts, list(Ts), Ts.numpy()):
        found = over_wire(path(stamps, given, 'map'))
        assert [stamp_ns(pose.header.stamp) for pose in found.poses] == stamps
        assert {pose.header.frame_id for pose in found.poses} == {'map'}
        assert stamp_ns(found.header.stamp) == stamps[-1]
        torch.testing.assert_close(torch.stack([matrix(pose.pose) for pose in found.poses]), Ts,
                                   atol=EXACT, rtol=0)


def test_an_empty_path() -> None:
    assert over_wire(path([], [], 'map')).poses == []


def test_axes_of_the_map() -> None:
    """A camera that looks ahead, level: forward is x, its right is -y, its down is -z."""
    right, down, forward = (T_ZUP_OPTICAL[:3, i].tolist() for i in range(3))
    assert (forward, right, down) == ([1, 0, 0], [0, -1, 0], [0, 0, -1])
    torch.testing.assert_close(T_ZUP_OPTICAL[:3, :3].det(), torch.tensor(1.0, dtype=torch.float64))


def test_a_quaternion_of_any_length_is_a_rotation() -> None:
    pose = Pose()
    pose.orientation.z = pose.orientation.w = 3.0
    quarter_turn = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    torch.testing.assert_close(matrix(over_wire(pose))[:3, :3], quarter_turn.double(),
                               atol=EXACT, rtol=0)


@pytest.mark.parametrize('field, name, value, text', [
    ('position', 'x', math.nan, 'not finite'),
    ('position', 'z', math.inf, 'not finite'),
    ('orientation', 'y', math.nan, 'not finite'),
    ('orientation', 'w', 0.0, 'length 0'),
    ('orientation', 'w', 1e-9, 'length 0'),
])
def test_a_bad_pose_is_named(field: str, name: str, value: float, text: str) -> None:
    pose = Pose()
    setattr(getattr(pose, field), name, value)
    with pytest.raises(MessageError, match=text):
        matrix(over_wire(pose))


@pytest.mark.parametrize('T', [
    torch.full((4, 4), torch.nan, dtype=torch.float64),
    torch.zeros(4, 4, dtype=torch.float64),
    torch.diag(torch.tensor([-1.0, 1.0, 1.0, 1.0], dtype=torch.float64)),
])
def test_a_matrix_that_is_no_transform_is_not_sent(T: Tensor) -> None:
    with pytest.raises(MessageError, match='not finite or not a rotation'):
        pose_msg(T)


@pytest.mark.parametrize('ns', [0, 1, 999_999_999, 1_000_000_000, STAMP, -1, 2**31 * 10**9 - 1])
def test_stamps_are_exact(ns: int) -> None:
    """Nanoseconds since the epoch do not fit a float64: no float may be on the way."""
    assert stamp_ns(over_wire(stamp_msg(ns))) == ns


@pytest.mark.parametrize('ns', [2**31 * 10**9, -2**31 * 10**9 - 1])
def test_a_stamp_outside_of_ros_time_is_named(ns: int) -> None:
    with pytest.raises(MessageError, match='check the clock'):
        stamp_msg(ns)


def test_the_same_pose_gives_the_same_bytes() -> None:
    T = _transforms(1)[0]
    assert pose_msg(T) == pose_msg(T.clone())
