"""Opened bags: rosbag2 (mcap, sqlite3) and ROS 1, read without ROS."""

from __future__ import annotations

import struct
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Collection, Generator, Iterator
from weakref import WeakSet

import apsw
from rosbags.convert.converter import is_same_wireformat
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.interfaces import Connection, ConnectionExtRosbag1, QosDurability
from rosbags.rosbag1 import ReaderError as Reader1Error
from rosbags.rosbag2 import ReaderError as Reader2Error
from rosbags.rosbag2.reader import zstd
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore

from aim_slam_ros.datasets.base import DatasetError

STORE = get_typestore(Stores.ROS2_JAZZY)
SUFFIXES = ('.mcap', '.db3', '.bag')
_METADATA = 'metadata.yaml'
_MARK = b'rosbag2_bagfile_information'      # how that file begins
# What rosbags lets through on damaged files, besides its own errors.
_DAMAGE = (AnyReaderError, Reader1Error, Reader2Error, SerdeError, OSError, ValueError, TypeError,
           LookupError, ArithmeticError, AssertionError, EOFError, MemoryError, RuntimeError,
           struct.error, apsw.Error, zstd.ZstdError)
_REPAIR = {
    '.mcap': 'copy it again, or repair it with "mcap recover FILE -o NEW.mcap" (mcap.dev)',
    '.db3': 'copy it again, or repair it with "sqlite3 FILE .recover"',
    '.bag': 'copy it again, or repair it with "rosbag reindex FILE"',
    '': 'copy it again, or repair it with "ros2 bag reindex FOLDER" (for mcap files also '
        '"mcap recover")',
}
_CUT_SHORT = ('end magic', 'Truncated', 'not indexed', 'index looks damaged')


@dataclass(frozen=True)
class BagTopic:
    """latched: its messages are for late subscribers too. conforms: they can be had as CDR of the
    type that ROS 2 Jazzy has under this name."""

    name: str
    msgtype: str
    count: int
    latched: bool
    conforms: bool


@dataclass(frozen=True)
class BagMessage:
    """log_ns: when it was recorded. cdr: serialised for ROS 2; None where it is damaged."""

    topic: str
    log_ns: int
    cdr: bytes | None


class Bag:
    """A bag that is open for reading until ``close``.

    topics: by name, without those of which nothing was recorded. start_ns, end_ns: times of the
    first and the last message.
    """

    def __init__(self, path: Path) -> None:
        """path: a rosbag2 folder, a single .mcap or .db3, or a ROS 1 .bag; raises DatasetError."""
        self.path = path
        self._is_ros1 = path.suffix.lower() == '.bag'
        self._reader = _opened(path)
        self._iterations: WeakSet[Generator[BagMessage, None, None]] = WeakSet()
        self._connections: dict[str, list[Connection]] = {}
        for connection in self._reader.connections:
            if connection.msgcount:
                self._connections.setdefault(connection.topic, []).append(connection)
        if not self._connections:
            self.close()
            raise DatasetError(path, 'is a bag without messages', 'record it again')
        self.topics = {name: self._topic(name) for name in sorted(self._connections)}
        self.start_ns, self.end_ns = self._reader.start_time, self._reader.end_time - 1

    def messages(self, topics: Collection[str], start_ns: int | None = None,
                 stop_ns: int | None = None) -> Iterator[BagMessage]:
        """Messages of these topics in the order of log times, start_ns <= time < stop_ns.

        Raises DatasetError where the file is damaged: nothing can be read on from there.
        """
        messages = self._messages(topics, start_ns, stop_ns)
        self._iterations.add(messages)
        return messages

    def close(self) -> None:
        """Also ends what iterates over messages. May be called twice."""
        try:
            for messages in list(self._iterations):
                messages.close()
            if self._reader.stack is not None:
                self._reader.close()
        except (ValueError, apsw.BusyError):
            pass    # a thread is still reading: the files are closed when it is done

    def _messages(self, topics: Collection[str], start_ns: int | None,
                  stop_ns: int | None) -> Generator[BagMessage, None, None]:
        wanted = [connection for name in topics for connection in self._connections[name]]
        try:
            with closing(self._reader.messages(wanted, start_ns, stop_ns)) as records:
                for connection, log_ns, raw in records:
                    yield BagMessage(connection.topic, log_ns, self._cdr(connection, raw))
        except _DAMAGE as error:
            raise _unreadable(self.path, error) from error

    def _cdr(self, connection: Connection, raw: bytes) -> bytes | None:
        if not self._is_ros1:
            return bytes(raw)
        try:
            return bytes(STORE.ros1_to_cdr(raw, connection.msgtype))
        except SerdeError:
            return None

    def _topic(self, name: str) -> BagTopic:
        connections = self._connections[name]
        msgtype = connections[0].msgtype
        latched = any(
            bool(ext.latching) if isinstance(ext, ConnectionExtRosbag1)
            else any(qos.durability is QosDurability.TRANSIENT_LOCAL
                     for qos in ext.offered_qos_profiles)
            for ext in (connection.ext for connection in connections))
        return BagTopic(name, msgtype, sum(c.msgcount for c in connections), latched,
                        all(c.msgtype == msgtype for c in connections) and self._conforms(msgtype))

    def _conforms(self, msgtype: str) -> bool:
        # Types of its own a ROS 2 bag may hold: their layout is whatever is installed.
        if msgtype not in STORE.fielddefs or msgtype not in self._reader.typestore.fielddefs:
            return not self._is_ros1
        try:
            return is_same_wireformat(self._reader.typestore, STORE, msgtype, msgtype)
        except LookupError:     # its definition lacks that of a part
            return False


def is_bag(path: Path) -> bool:
    """Whether it looks like one, whole or damaged."""
    if not path.is_dir():
        return path.suffix.lower() in SUFFIXES
    return bool(_storage_files(path)) or _MARK in _beginning(path / _METADATA)


def header_stamp_ns(cdr: bytes) -> int | None:
    """header.stamp of a message whose first field is a header; None where it is damaged."""
    if len(cdr) < 12:
        return None
    sec, nanosec = struct.unpack_from('<iI' if cdr[1] & 1 else '>iI', cdr, 4)
    return sec * 1_000_000_000 + nanosec if nanosec < 1_000_000_000 else None


def _beginning(path: Path) -> bytes:
    """Of a file; empty where there is none."""
    try:
        with path.open('rb') as file:
            return file.read(len(_MARK))
    except OSError:
        return b''


def _storage_files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.suffix in ('.mcap', '.db3'))


def _opened(path: Path) -> AnyReader:
    if not path.exists():
        raise DatasetError(path, 'does not exist', 'check the path')
    if not is_bag(path):
        raise DatasetError(path, 'is no bag', 'name a rosbag2 folder, a .mcap or .db3 file in it, '
                           'or a ROS 1 .bag')
    if path.is_dir() and not (path / _METADATA).exists():
        files = ' or '.join(file.name for file in _storage_files(path)[:3])
        raise DatasetError(path, f'is a bag without its {_METADATA}: its recorder was not closed, '
                           'or the file was not copied', 'run "ros2 bag reindex" on the folder, '
                           f'or name the file in it ({files})')
    try:
        reader = AnyReader([path], default_typestore=STORE)
        reader.open()
    except _DAMAGE as error:
        raise _unreadable(path, error) from error
    return reader


def _unreadable(path: Path, error: Exception) -> DatasetError:
    if isinstance(error, PermissionError):
        return DatasetError(path, 'may not be read', 'change the permissions of its files')
    reason = str(error) or type(error).__name__
    if any(words in reason for words in _CUT_SHORT):
        reason = f'cut short, or its recorder was not closed: {reason}'
    return DatasetError(path, f'is a bag that cannot be read ({reason.rstrip(".")})',
                        _REPAIR.get(path.suffix.lower(), _REPAIR['']))
