"""A typed table as PointCloud2: what numpy calls a structured array.

A pure Python package cannot define messages; a PointCloud2 names and types its columns itself,
RViz shows it where it has x y z, and numpy reads it without a copy. It knows no 64-bit integers.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from sensor_msgs.msg import PointCloud2, PointField

from .errors import MessageError
from .payload import bytes_of, data_of
from .stamps import header

_TYPES = {PointField.INT8: 'i1', PointField.UINT8: 'u1', PointField.INT16: 'i2',
          PointField.UINT16: 'u2', PointField.INT32: 'i4', PointField.UINT32: 'u4',
          PointField.FLOAT32: 'f4', PointField.FLOAT64: 'f8'}
_NAMES = {'i1': 'INT8', 'u1': 'UINT8', 'i2': 'INT16', 'u2': 'UINT16', 'i4': 'INT32',
          'u4': 'UINT32', 'f4': 'FLOAT32', 'f8': 'FLOAT64'}
_CODES = {kind: code for code, kind in _TYPES.items()}
_NONE = np.dtype([])
_MAX_POINT_STEP = 2 ** 31 - 1   # numpy takes no more


def table_msg(rows: np.ndarray, stamp_ns: int, frame_id: str) -> PointCloud2:
    """rows: structured, little-endian, [N] (unorganised) or [H,W] (organised); one copy is made.

    A column may be an array itself (a subarray dtype). is_dense is False where x, y or z is NaN.
    """
    dtype = rows.dtype
    msg = PointCloud2(check_fields=True)
    msg.header = header(stamp_ns, frame_id)
    msg.height, msg.width = rows.shape if rows.ndim == 2 else (1, len(rows))
    msg.fields = [_point_field(name, dtype) for name in dtype.names or ()]
    msg.is_bigendian = False
    msg.point_step, msg.row_step = dtype.itemsize, dtype.itemsize * msg.width
    msg.is_dense = all(bool(np.isfinite(rows[axis]).all()) for axis in 'xyz')
    msg.data = data_of(rows)
    return msg


def _point_field(name: str, dtype: np.dtype) -> PointField:
    fields: Any = dtype.fields
    column, offset = fields[name][:2]
    return PointField(name=name, offset=offset, datatype=_CODES[_kind(column)],
                      count=int(np.prod(column.shape, dtype=int)))


def rows_of(msg: Any, columns: np.dtype, any_length: np.dtype = _NONE) -> np.ndarray:
    """The rows of a table [height,width], structured: a view, not a copy, of the message's data.

    columns: what must be there, with type and length; other columns are there as well where the
    message has them. any_length: columns that must be there with the type given and any length.
    Raises MessageError.
    """
    dtype = _dtype(msg)
    for name in columns.names or ():
        _check_column(name, dtype, columns[name])
    for name in any_length.names or ():
        _check_column(name, dtype, any_length[name], any_length=True)
    height, width, row_step = int(msg.height), int(msg.width), int(msg.row_step)
    if row_step < width * dtype.itemsize:
        raise MessageError(f'a table has rows of {row_step} bytes, but {width} points of '
                           f'{dtype.itemsize} bytes: its width, row_step or point_step is wrong')
    if len(msg.data) != height * row_step:
        raise MessageError(f'a table has {len(msg.data)} bytes of data, but height x row_step is '
                           f'{height * row_step}: it is cut off or its sizes are wrong')
    if not height * width:
        return np.empty((height, width), dtype)
    rows = np.ndarray((height, width), dtype, bytes_of(msg.data),
                      strides=(row_step, dtype.itemsize))
    return rows.astype(dtype.newbyteorder('<')) if msg.is_bigendian else rows


def _dtype(msg: Any) -> np.dtype:
    """Of one point, from the message's own description."""
    order, point_step = '>' if msg.is_bigendian else '<', int(msg.point_step)
    if not 0 < point_step <= _MAX_POINT_STEP:
        raise MessageError(f'a table has points of {point_step} bytes: its point_step is wrong')
    names, formats, offsets = [], [], []
    for field in msg.fields:
        kind = _TYPES.get(field.datatype)
        if kind is None:
            raise MessageError(f"column '{field.name}' of a table has the unknown type "
                               f'{field.datatype}')
        count = int(field.count) or 1   # some old publishers leave it 0
        end = field.offset + count * np.dtype(kind).itemsize
        if not field.name or field.name in names or end > point_step:
            raise MessageError(f"column '{field.name}' of a table has no name, is there twice or "
                               f'reaches past the {point_step} bytes of a point')
        names.append(field.name)
        formats.append((order + kind, (count,) if count > 1 else ()))
        offsets.append(int(field.offset))
    return np.dtype({'names': names, 'formats': formats, 'offsets': offsets,
                     'itemsize': point_step})


def _check_column(name: str, dtype: np.dtype, wanted: np.dtype, any_length: bool = False) -> None:
    if name not in (dtype.names or ()):
        raise MessageError(f"a table lacks the column '{name}': it has "
                           f'{", ".join(dtype.names or ()) or "none"}. Do both nodes have the '
                           'same version, and is the topic the right one?')
    found = dtype[name]
    if _kind(found) != _kind(wanted) or not any_length and found.shape != wanted.shape:
        raise MessageError(f"column '{name}' of a table is {_described(found)} instead of "
                           f'{_described(wanted)}: do both nodes have the same version?')


def _kind(column: np.dtype) -> str:
    """Type and size without the byte order: 'f4'."""
    return column.base.str[1:]


def _described(column: np.dtype) -> str:
    name = _NAMES[_kind(column)]
    return f'{name}[{column.shape[0]}]' if column.shape else name
