"""Messages as the other side gets them."""

from __future__ import annotations

from typing import Any, TypeVar

from rclpy.serialization import deserialize_message, serialize_message
from rosbags.typesys import Stores, get_typestore

M = TypeVar('M')


def over_wire(msg: M) -> M:
    """Serialised and read again, as DDS does it."""
    return deserialize_message(serialize_message(msg), type(msg))


def as_in_bag(msg: Any) -> Any:
    """Serialised by ROS and read by rosbags, which needs no ROS and gives numpy arrays."""
    package, kind = type(msg).__module__.split('.')[0], type(msg).__name__
    typestore = get_typestore(Stores.ROS2_JAZZY)
    return typestore.deserialize_cdr(serialize_message(msg), f'{package}/msg/{kind}')
