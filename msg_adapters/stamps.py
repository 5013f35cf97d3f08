"""Stamps: nanoseconds since the epoch, as an int, and builtin_interfaces/Time; headers."""

from __future__ import annotations

from typing import Any

from builtin_interfaces.msg import Time
from std_msgs.msg import Header

from .errors import MessageError

NS_PER_S = 1_000_000_000
_MAX_SECONDS = 2 ** 31


def stamp_ns(stamp: Any) -> int:
    """Nanoseconds of a Time message (anything with ``sec`` and ``nanosec``)."""
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


def stamp_msg(ns: int) -> Time:
    """Raises MessageError for a time that the message's 32-bit seconds cannot hold."""
    seconds, nanoseconds = divmod(int(ns), NS_PER_S)
    if not -_MAX_SECONDS <= seconds < _MAX_SECONDS:
        raise MessageError(f'a stamp of {ns} ns lies outside what a ROS time can hold '
                           '(1901 to 2038): check the clock of the image source')
    return Time(sec=seconds, nanosec=nanoseconds)


def header(ns: int, frame_id: str) -> Header:
    """Raises MessageError as stamp_msg does."""
    return Header(stamp=stamp_msg(ns), frame_id=frame_id)
