"""The keyframe event over real serialisation."""

from __future__ import annotations

import dataclasses
from typing import Any, Callable

import numpy as np
import pytest
import torch
from sensor_msgs.msg import PointCloud2, PointField
from torch import Tensor
from torch.nn.functional import normalize
from wire import as_in_bag, over_wire

from aim_slam_ros.geometry import sim3
from aim_slam_ros.types import KeyframeEvent, KeyframePose, PoseEdge
from msg_adapters.clouds import cloud_from_msg
from msg_adapters.errors import MessageError
from msg_adapters.keyframes import KeyframeMessages, keyframe_event, keyframe_messages
from msg_adapters.payload import data_of
from msg_adapters.stamps import stamp_msg, stamp_ns
from msg_adapters.tables import rows_of, table_msg

STAMP = 1_305_031_102_175_304_001
SESSION = 4_000_000_007   # above 2^31: an unsigned number
HEIGHT, WIDTH = 28, 42
# float32 has 24 bits: 6e-8 of a value; poses have values up to 4, and a quaternion's error is
# doubled in its matrix.
FLOAT32 = 1e-6


def _pose(seed: int) -> Tensor:
    return sim3.exp(torch.randn(7, dtype=torch.float64,
                                generator=torch.Generator().manual_seed(seed)))


def _event(edges: int = 2, moved: int = 2, dimension: int = 5) -> KeyframeEvent:
    rng = np.random.default_rng(3)
    generator = torch.Generator().manual_seed(3)
    return KeyframeEvent(
        keyframe_id=12, piece_id=1, stamp_ns=STAMP,
        image=rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8),
        K=torch.tensor([[40.5, 0.0, 21.0], [0.0, 41.25, 14.0], [0.0, 0.0, 1.0]],
                       dtype=torch.float64),
        points_cam=torch.rand(HEIGHT, WIDTH, 3, generator=generator) + 0.5,
        confidence=torch.rand(HEIGHT, WIDTH, generator=generator) * 100 + 1,
        T_world_kf=_pose(12),
        descriptor=normalize(torch.rand(dimension, generator=generator), dim=0),
        edges=tuple(PoseEdge(11 - i, 12, _pose(20 + i), torch.rand(
            7, dtype=torch.float64, generator=generator) + 0.01) for i in range(edges)),
        moved=tuple(KeyframePose(7 + i, _pose(30 + i)) for i in range(moved)), observations=4)


def _messages(event: KeyframeEvent | None = None) -> KeyframeMessages:
    return keyframe_messages(event or _event(), SESSION, 'camera_optical_frame', 'map')


def _assert_close(found: Tensor, expected: Tensor) -> None:
    assert found.dtype == expected.dtype
    torch.testing.assert_close(found, expected, atol=FLOAT32 * 4, rtol=FLOAT32)


def _assert_same(found: KeyframeEvent, event: KeyframeEvent) -> None:
    assert (found.keyframe_id, found.piece_id, found.stamp_ns, found.observations) == (
        event.keyframe_id, event.piece_id, event.stamp_ns, event.observations)
    np.testing.assert_array_equal(found.image, event.image)
    assert torch.equal(found.confidence, event.confidence)
    assert torch.equal(found.descriptor, event.descriptor)
    for name in ('K', 'points_cam', 'T_world_kf'):
        _assert_close(getattr(found, name), getattr(event, name))
    assert [(e.a, e.b) for e in found.edges] == [(e.a, e.b) for e in event.edges]
    for found_edge, edge in zip(found.edges, event.edges):
        _assert_close(found_edge.T_a_b, edge.T_a_b)
        _assert_close(found_edge.sigma, edge.sigma)
    assert [p.keyframe_id for p in found.moved] == [p.keyframe_id for p in event.moved]
    for found_pose, pose in zip(found.moved, event.moved):
        _assert_close(found_pose.T_world_kf, pose.T_world_kf)


@pytest.mark.parametrize('read', [over_wire, as_in_bag])
@pytest.mark.parametrize('edges, moved, dimension', [(2, 2, 5), (0, 0, 512), (3, 0, 1), (0, 1, 2)])
def test_round_trip(edges: int, moved: int, dimension: int,
                    read: Callable[[PointCloud2], Any]) -> None:
    event = _event(edges, moved, dimension)
    messages = _messages(event)
    received = keyframe_event(read(messages.table), read(messages.cloud))
    assert received.session_id == SESSION
    _assert_same(received.event, event)


def test_what_is_received_is_a_copy() -> None:
    """The message's memory may go, and the receiver may write."""
    messages = _messages()
    event = keyframe_event(messages.table, messages.cloud).event
    for msg in (messages.table, messages.cloud):
        np.frombuffer(msg.data, np.uint8)[:] = 0
    _assert_same(event, _event())


def test_headers() -> None:
    messages = _messages()
    table, cloud = over_wire(messages.table), over_wire(messages.cloud)
    assert stamp_ns(table.header.stamp) == stamp_ns(cloud.header.stamp) == STAMP
    assert (table.header.frame_id, cloud.header.frame_id) == ('map', 'camera_optical_frame')
    assert (table.height, table.width) == (1, 5)
    assert (cloud.height, cloud.width) == (HEIGHT, WIDTH)


def test_the_cloud_is_in_the_unit_of_the_map_and_any_viewer_can_read_it() -> None:
    event = _event()
    cloud = cloud_from_msg(over_wire(_messages(event).cloud))
    expected = float(sim3.scale_of(event.T_world_kf)) * event.points_cam.reshape(-1, 3)
    _assert_close(torch.from_numpy(cloud.points), expected)
    np.testing.assert_array_equal(cloud.colours, event.image.reshape(-1, 3))


def test_poses_are_z_up_and_edges_are_between_optical_frames() -> None:
    """One unit ahead of the first camera is x = 1 of the map, one below it z = -1."""
    T = sim3.from_parts(2.0, torch.eye(3), torch.tensor([0.0, 1.0, 3.0]))
    edge = PoseEdge(11, 12, T, torch.ones(7, dtype=torch.float64))
    event = dataclasses.replace(_event(), T_world_kf=T, moved=(KeyframePose(3, T),), edges=(edge,))
    rows = rows_of(over_wire(_messages(event).table), np.dtype([('x', '<f4')]))[0]
    assert [rows[name].tolist() for name in 'xyz'] == [[3, 3, 0], [0, 0, 1], [-1, -1, 3]]
    assert rows['scale'].tolist() == [2, 2, 2]
    assert rows['kind'].tolist() == [0, 1, 2]
    assert rows['keyframe_id'].tolist() == [12, 3, 11]
    assert rows['other_id'].tolist() == [0, 0, 12]


def test_points_without_depth_stay_nan() -> None:
    event = _event()
    event.points_cam[3, 4] = torch.nan
    messages = _messages(event)
    assert not messages.cloud.is_dense
    found = keyframe_event(messages.table, over_wire(messages.cloud)).event
    assert found.points_cam.isnan().nonzero().tolist() == [[3, 4, i] for i in range(3)]


def test_columns_of_a_later_version_are_passed_over() -> None:
    messages = _messages()
    rows = rows_of(messages.table, np.dtype([]))[0]
    more = np.zeros(len(rows), [('new', '<f8', (2,)), *(
        (name, rows.dtype[name]) for name in reversed(rows.dtype.names or ()))])
    for name in rows.dtype.names or ():
        more[name] = rows[name]
    table = over_wire(table_msg(more, STAMP, 'map'))
    _assert_same(keyframe_event(table, messages.cloud).event, _event())


def _edited(msg: PointCloud2, column: str, row: int, value: Any) -> PointCloud2:
    rows_of(msg, np.dtype([]))[0][column][row] = value
    return msg


def _bad_table(column: str, row: int, value: Any) -> KeyframeMessages:
    messages = _messages()
    return dataclasses.replace(messages, table=_edited(messages.table, column, row, value))


def _zero_quaternion(row: int) -> KeyframeMessages:
    messages = _messages()
    for column in ('qx', 'qy', 'qz', 'qw'):
        _edited(messages.table, column, row, 0.0)
    return messages


def _restamped(table: int, cloud: int) -> KeyframeMessages:
    messages = _messages()
    messages.table.header.stamp, messages.cloud.header.stamp = stamp_msg(table), stamp_msg(cloud)
    return messages


def _without(column: str, of: str) -> KeyframeMessages:
    messages = _messages()
    msg = getattr(messages, of)
    msg.fields = [field for field in msg.fields if field.name != column]
    return messages


def _cut(of: str) -> KeyframeMessages:
    messages = _messages()
    msg = getattr(messages, of)
    msg.data = msg.data[:-4]
    return messages


def _no_rows() -> KeyframeMessages:
    messages = _messages()
    messages.table.width = messages.table.row_step = 0
    messages.table.data = data_of(np.zeros(0, np.uint8))
    return messages


def _flat_cloud() -> KeyframeMessages:
    messages = _messages()
    cloud = messages.cloud
    cloud.height, cloud.width, cloud.row_step = 1, HEIGHT * WIDTH, len(cloud.data)
    return messages


def _swapped() -> KeyframeMessages:
    messages = _messages()
    return KeyframeMessages(messages.cloud, messages.table)


# Rows of the table: 0 new, 1 and 2 moved, 3 and 4 edges.
BAD_KEYFRAMES: dict[str, tuple[KeyframeMessages, str]] = {
    'swapped': (_swapped(), "lacks the column 'qx'"),
    'empty messages': (KeyframeMessages(PointCloud2(), PointCloud2()), 'point_step is wrong'),
    'no descriptor': (_without('descriptor', 'table'), "lacks the column 'descriptor'"),
    'no confidence': (_without('confidence', 'cloud'), "lacks the column 'confidence'"),
    'table cut off': (_cut('table'), 'cut off'),
    'cloud cut off': (_cut('cloud'), 'cut off'),
    'no rows': (_no_rows(), 'has no rows'),
    'cloud not organised': (_flat_cloud(), 'must be organised'),
    'cloud of another keyframe': (_restamped(STAMP, STAMP + 1), 'pair them by equal stamps'),
    'table of another image': (_restamped(STAMP + 1, STAMP), 'pair them by equal stamps'),
    'rows of another image': (_restamped(STAMP + 1, STAMP + 1), 'pair them by equal stamps'),
    'new keyframe not first': (_bad_table('kind', 0, 1), 'the first must be 0'),
    'two new keyframes': (_bad_table('kind', 2, 0), 'the first must be 0'),
    'unknown kind': (_bad_table('kind', 4, 3), 'the first must be 0'),
    'two sessions': (_bad_table('session_id', 2, 1), 'several sessions'),
    'NaN position': (_bad_table('x', 0, np.nan), "keyframe's pose holds values .* not finite"),
    'infinite moved position': (_bad_table('z', 2, np.inf), "keyframe's pose holds values"),
    'NaN quaternion': (_bad_table('qx', 1, np.nan), "keyframe's pose holds values"),
    'zero quaternion': (_zero_quaternion(1), 'quaternion of length 0'),
    'zero quaternion of an edge': (_zero_quaternion(4), 'quaternion of length 0'),
    'zero scale': (_bad_table('scale', 0, 0.0), 'scale of 0, but it must be positive'),
    'negative scale': (_bad_table('scale', 1, -2.0), 'scale of -2'),
    'NaN edge': (_bad_table('qy', 3, np.nan), 'an edge holds values'),
    'no focal length': (_bad_table('fx', 0, 0.0), 'the intrinsics fx 0'),
    'NaN centre': (_bad_table('cx', 0, np.nan), 'cx nan'),
    'NaN descriptor': (_bad_table('descriptor', 0, np.nan), 'descriptor holds values'),
    'zero sigma': (_bad_table('sigma', 3, 0.0), "an edge's sigma"),
    'NaN sigma': (_bad_table('sigma', 4, np.nan), "an edge's sigma"),
    'edge to itself': (_bad_table('other_id', 3, 11), 'joins a keyframe to itself'),
}


@pytest.mark.parametrize('read', [over_wire, as_in_bag])
@pytest.mark.parametrize('case', BAD_KEYFRAMES)
def test_a_bad_keyframe_is_named(case: str, read: Callable[[PointCloud2], Any]) -> None:
    messages, text = BAD_KEYFRAMES[case]
    with pytest.raises(MessageError, match=text):
        keyframe_event(read(messages.table), read(messages.cloud))


@pytest.mark.parametrize('of', ['table', 'cloud'])
def test_every_column_is_needed_with_its_type(of: str) -> None:
    for name in [field.name for field in getattr(_messages(), of).fields]:
        messages = _without(name, of)
        with pytest.raises(MessageError, match=f"lacks the column '{name}'"):
            keyframe_event(messages.table, messages.cloud)
        messages = _messages()
        next(f for f in getattr(messages, of).fields if f.name == name).datatype = PointField.INT8
        with pytest.raises(MessageError, match=f"column '{name}' of a table is INT8"):
            keyframe_event(messages.table, messages.cloud)


@pytest.mark.parametrize('of', ['table', 'cloud'])
def test_random_bytes_give_an_event_or_a_message_error(of: str) -> None:
    """Damaged data: whatever its numbers are, no other exception."""
    rng = np.random.default_rng(0)
    for _ in range(100):
        messages = _messages()
        data = np.frombuffer(getattr(messages, of).data, np.uint8)
        data[rng.integers(0, len(data), 3)] = rng.integers(0, 256, 3)
        try:
            keyframe_event(messages.table, messages.cloud)
        except MessageError:
            continue


def test_a_pose_that_is_no_transform_is_not_sent() -> None:
    with pytest.raises(MessageError, match='not finite or not a rotation'):
        _messages(dataclasses.replace(_event(), T_world_kf=_pose(1) * torch.nan))
