"""Typed tables over real serialisation, and every way in which a table can be wrong."""

from __future__ import annotations

from typing import Any, Callable

import numpy as np
import pytest
from sensor_msgs.msg import PointCloud2, PointField
from wire import as_in_bag, over_wire

from msg_adapters.errors import MessageError
from msg_adapters.payload import data_of
from msg_adapters.stamps import stamp_ns
from msg_adapters.tables import rows_of, table_msg

STAMP = 1_305_031_102_175_304_001
COLUMNS: list[Any] = [('x', '<f4'), ('y', '<f4'), ('z', '<f4'), ('id', '<u4'), ('kind', 'u1'),
                      ('sec', '<i4'), ('sigma', '<f4', (7,))]
DTYPE = np.dtype(COLUMNS)


def _rows(*shape: int) -> np.ndarray:
    rng = np.random.default_rng(0)
    rows = np.zeros(shape, DTYPE)
    for name in ('x', 'y', 'z', 'sigma'):
        rows[name] = rng.normal(size=rows[name].shape)
    for name in ('id', 'kind', 'sec'):
        limits = np.iinfo(DTYPE[name])
        rows[name] = rng.integers(limits.min, limits.max, shape, endpoint=True)
    return rows


@pytest.mark.parametrize('read', [over_wire, as_in_bag])
@pytest.mark.parametrize('shape', [(5,), (1,), (4, 6)])
def test_round_trip_is_exact(shape: tuple[int, ...], read: Callable[[PointCloud2], Any]) -> None:
    rows = _rows(*shape)
    msg = read(table_msg(rows, STAMP, 'map'))
    assert (stamp_ns(msg.header.stamp), msg.header.frame_id) == (STAMP, 'map')
    assert msg.is_dense
    found = rows_of(msg, DTYPE)
    assert found.shape == (shape if len(shape) == 2 else (1, *shape))
    for name in DTYPE.names or ():
        np.testing.assert_array_equal(found[name].reshape(rows[name].shape), rows[name])


def test_a_table_without_rows() -> None:
    assert rows_of(over_wire(table_msg(_rows(0), STAMP, 'map')), DTYPE).shape == (1, 0)


def test_reading_copies_nothing() -> None:
    msg = over_wire(table_msg(_rows(5), STAMP, 'map'))
    assert np.shares_memory(rows_of(msg, DTYPE), np.frombuffer(msg.data, np.uint8))


def test_a_nan_position_is_not_dense() -> None:
    rows = _rows(5)
    rows['y'][3] = np.nan
    assert not table_msg(rows, STAMP, 'map').is_dense


def test_other_columns_in_any_order_are_accepted() -> None:
    more = np.zeros(5, [('note', '<f8'), *reversed(COLUMNS), ('other', '<i2', (3,))])
    for name in DTYPE.names or ():
        more[name] = _rows(5)[name]
    found = rows_of(over_wire(table_msg(more, STAMP, 'map')), DTYPE)
    np.testing.assert_array_equal(found['id'][0], _rows(5)['id'])
    np.testing.assert_array_equal(found['sigma'][0], _rows(5)['sigma'])


@pytest.mark.parametrize('length', [1, 2, 512])
def test_an_array_column_of_any_length(length: int) -> None:
    rows = np.zeros(2, [('x', '<f4'), ('y', '<f4'), ('z', '<f4'), ('d', '<f4', (length,))])
    rows['d'] = 1.5
    msg = over_wire(table_msg(rows, STAMP, 'map'))
    found = rows_of(msg, DTYPE[['x']], np.dtype([('d', '<f4')]))
    assert found['d'].size == 2 * length and (found['d'] == 1.5).all()


def test_gaps_between_columns_points_and_rows() -> None:
    """As other publishers lay out their clouds: x at 4, points of 16 bytes, rows of 80."""
    data = np.full((3, 80), 0xee, np.uint8)
    x = np.arange(12, dtype='<f4').reshape(3, 4)
    data[:, :64].reshape(3, 4, 16)[..., 4:8] = x.view(np.uint8).reshape(3, 4, 4)
    msg = PointCloud2(height=3, width=4, point_step=16, row_step=80, fields=[
        PointField(name='x', offset=4, datatype=PointField.FLOAT32, count=0)])
    msg.data = data_of(data)
    np.testing.assert_array_equal(rows_of(over_wire(msg), DTYPE[['x']])['x'], x)


def test_big_endian_tables() -> None:
    rows = _rows(5)
    msg = table_msg(rows, STAMP, 'map')
    msg.data, msg.is_bigendian = data_of(rows.astype(DTYPE.newbyteorder('>'))), True
    found = rows_of(over_wire(msg), DTYPE)[0]
    for name in DTYPE.names or ():
        np.testing.assert_array_equal(found[name], rows[name])
        assert found[name].dtype.isnative


def _table(**changes: Any) -> PointCloud2:
    msg = table_msg(_rows(5), STAMP, 'map')
    for name, value in changes.items():
        setattr(msg, name, value)
    return msg


def _field(index: int, **changes: Any) -> PointCloud2:
    msg = _table()
    for name, value in changes.items():
        setattr(msg.fields[index], name, value)
    return msg


SIGMA = len(COLUMNS) - 1
BAD_TABLES: dict[str, tuple[PointCloud2, str]] = {
    'an empty message': (PointCloud2(), 'point_step is wrong'),
    'no columns': (_table(fields=[]), "lacks the column 'x'.*none"),
    'a column is missing': (_field(3, name='ident'), "lacks the column 'id'.*ident"),
    'another type': (_field(3, datatype=PointField.FLOAT32), 'is FLOAT32 instead of UINT32'),
    'another length': (_field(SIGMA, count=6), r'FLOAT32\[6\] instead of FLOAT32\[7\]'),
    'no array': (_field(SIGMA, count=1), r'FLOAT32 instead of FLOAT32\[7\]'),
    'an unknown type': (_field(3, datatype=9), 'unknown type 9'),
    'a column twice': (_field(1, name='x'), 'is there twice'),
    'a column without a name': (_field(1, name=''), 'has no name'),
    'a column outside of its point': (_field(0, offset=49), 'reaches past the 49 bytes'),
    'an endless column': (_field(SIGMA, count=2**32 - 1), 'reaches past'),
    'points of no size': (_table(point_step=0), 'points of 0 bytes'),
    'points too large': (_table(point_step=2**32 - 1), 'its point_step is wrong'),
    'rows too short': (_table(row_step=5 * 49 - 1), 'rows of 244 bytes'),
    'too many points': (_table(width=6), 'rows of 245 bytes, but 6 points'),
    'too many rows': (_table(height=2), 'height x row_step is 490'),
    'data cut off': (_table(data=data_of(_rows(5).view(np.uint8)[:-1])), 'has 244 bytes of data'),
    'no data': (_table(data=data_of(np.zeros(0, np.uint8))), 'has 0 bytes of data'),
}


@pytest.mark.parametrize('read', [over_wire, as_in_bag])
@pytest.mark.parametrize('case', BAD_TABLES)
def test_a_bad_table_is_named(case: str, read: Callable[[PointCloud2], Any]) -> None:
    msg, text = BAD_TABLES[case]
    with pytest.raises(MessageError, match=text):
        rows_of(read(msg), DTYPE)


def test_an_array_column_of_another_type_is_named() -> None:
    with pytest.raises(MessageError, match="'id' of a table is UINT32 instead of FLOAT32"):
        rows_of(_table(), DTYPE[['x']], np.dtype([('id', '<f4')]))


@pytest.mark.parametrize('value', [0, 1, 2, 255, 2**16, 2**31, 2**32 - 1])
def test_any_number_gives_rows_or_a_message_error(value: int) -> None:
    """Whatever a single number of the message is: never another exception, never a crash."""
    messages = [_table(**{name: value})
                for name in ('height', 'width', 'point_step', 'row_step')]
    messages += [_field(index, **{name: value}) for name in ('offset', 'count')
                 for index in range(len(COLUMNS))]
    for msg in messages:
        try:
            rows_of(over_wire(msg), DTYPE).tobytes()
        except MessageError:
            continue
