"""Coloured clouds over real serialisation."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from sensor_msgs.msg import PointCloud2, PointField
from wire import as_in_bag, over_wire

from msg_adapters.clouds import cloud_from_msg, cloud_msg, packed, unpacked
from msg_adapters.errors import MessageError
from msg_adapters.stamps import stamp_ns

STAMP = 1_305_031_102_175_304_001


def _points(count: int) -> np.ndarray:
    return np.random.default_rng(0).normal(size=(count, 3)).astype(np.float32)


def _colours(count: int) -> np.ndarray:
    return np.random.default_rng(1).integers(0, 256, (count, 3), dtype=np.uint8)


@pytest.mark.parametrize('count', [0, 1, 1000])
def test_round_trip_is_exact(count: int) -> None:
    msg = cloud_msg(_points(count), _colours(count), STAMP, 'map')
    for read in (over_wire(msg), as_in_bag(msg)):
        cloud = cloud_from_msg(read)
        np.testing.assert_array_equal(cloud.points, _points(count))
        np.testing.assert_array_equal(cloud.colours, _colours(count))
        assert (cloud.points.dtype, cloud.colours.dtype) == (np.float32, np.uint8)
        assert (stamp_ns(read.header.stamp), read.header.frame_id) == (STAMP, 'map')


def test_the_layout_is_what_rviz_wants() -> None:
    """x y z rgb as FLOAT32, rgb with the bits 0x00RRGGBB, little-endian, one row."""
    msg = over_wire(cloud_msg(np.array([[1.5, -2.0, 3.25]], np.float32),
                              np.array([[0x12, 0x34, 0x56]], np.uint8), STAMP, 'map'))
    assert [(f.name, f.offset, f.datatype, f.count) for f in msg.fields] == [
        (name, 4 * i, PointField.FLOAT32, 1) for i, name in enumerate(('x', 'y', 'z', 'rgb'))]
    assert (msg.height, msg.width, msg.point_step, msg.row_step) == (1, 1, 16, 16)
    assert not msg.is_bigendian and msg.is_dense
    assert bytes(msg.data) == struct.pack('<fffI', 1.5, -2.0, 3.25, 0x00123456)


def test_points_that_are_not_there() -> None:
    points = _points(4)
    points[2] = np.nan
    msg = over_wire(cloud_msg(points, _colours(4), STAMP, 'map'))
    assert not msg.is_dense
    np.testing.assert_array_equal(cloud_from_msg(msg).points, points)


def test_every_channel_keeps_every_value() -> None:
    """Black and white, too: no bit pattern may be taken for a number and rounded."""
    values = np.arange(256, dtype=np.uint8)
    zeros = np.zeros_like(values)
    colours = np.concatenate([np.stack(channels, -1) for channels in (
        (values, zeros, zeros), (zeros, values, zeros), (zeros, zeros, values),
        (values, values, values))])
    np.testing.assert_array_equal(unpacked(packed(colours)), colours)


def test_double_precision_points_are_rounded() -> None:
    points = _points(5).astype(np.float64) + 1e-9
    cloud = cloud_from_msg(cloud_msg(points, _colours(5), STAMP, 'map'))
    np.testing.assert_array_equal(cloud.points, points.astype(np.float32))


@pytest.mark.parametrize('points, colours', [
    (_points(3), _colours(2)), (_points(3)[:, :2], _colours(3)[:, :2]),
    (_points(3)[0], _colours(1)),
])
def test_points_and_colours_must_fit(points: np.ndarray, colours: np.ndarray) -> None:
    with pytest.raises(MessageError, match='must both be'):
        cloud_msg(points, colours, STAMP, 'map')


def test_a_cloud_without_colour_is_named() -> None:
    msg: PointCloud2 = cloud_msg(_points(3), _colours(3), STAMP, 'map')
    msg.fields = msg.fields[:3]
    with pytest.raises(MessageError, match="lacks the column 'rgb'"):
        cloud_from_msg(over_wire(msg))
