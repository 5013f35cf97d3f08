"""The text files of datasets: stamped lists and trajectories."""

from __future__ import annotations

from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Callable, Iterator

import numpy as np
import torch

from aim_slam_ros.datasets.base import DatasetError
from aim_slam_ros.geometry import sim3
from aim_slam_ros.types import StampedPoses


@dataclass(frozen=True)
class Line:
    """A line that is neither blank nor a comment, split into its fields; counted from 1."""

    number: int
    fields: tuple[str, ...]


@dataclass(frozen=True)
class StampedList:
    """The readable lines of a stamped list, in the order of time.

    stamps_ns: [N] int64. values: the other fields of each line. dropped_stamps: lines with the
    stamp of one before them. unreadable_lines: lines that did not parse.
    """

    stamps_ns: np.ndarray
    values: tuple[tuple[str, ...], ...]
    dropped_stamps: int
    unreadable_lines: int


def read_text(path: Path) -> str:
    """The file's text; raises DatasetError."""
    try:
        return path.read_text(encoding='utf-8-sig')
    except OSError as error:
        raise DatasetError(path, f'cannot be read ({error.strerror})',
                           'restore the file or its permissions') from error
    except UnicodeDecodeError as error:
        raise DatasetError(path, 'is not a text file', 'restore it from the dataset') from error


def lines(path: Path, separator: str | None = None) -> Iterator[Line]:
    """Lines with content; ``#`` starts a comment."""
    for number, text in enumerate(read_text(path).splitlines(), 1):
        content = text.partition('#')[0].strip()
        if content:
            yield Line(number, tuple(field.strip() for field in content.split(separator)))


def ns_from_seconds(text: str) -> int:
    """'1305031102.175304' to nanoseconds, exactly: float64 is 0.2 us coarse there.

    Raises ValueError for what is not a time that fits an int64.
    """
    try:
        ns = Decimal(text) * 1_000_000_000
    except InvalidOperation as error:
        raise ValueError(f'{text!r} is not a time in seconds') from error
    if not ns.is_finite() or abs(ns) >= 2**63:
        raise ValueError(f'{text!r} is not a time in seconds')
    return int(ns.to_integral_value())


def read_stamped_list(path: Path, form: str, columns: int, separator: str | None = None,
                      stamp_ns: Callable[[str], int] = ns_from_seconds) -> StampedList:
    """A list with a stamp and at least ``columns`` - 1 other fields on each line.

    form: the expected line, for the message of the DatasetError raised when none is readable.
    """
    found, dropped, unreadable = dict[int, tuple[str, ...]](), 0, 0
    for line in lines(path, separator):
        try:
            stamp = stamp_ns(line.fields[0])
        except ValueError:
            stamp = None
        if stamp is None or len(line.fields) < columns or not all(line.fields[:columns]):
            unreadable += 1
        elif stamp in found:
            dropped += 1
        else:
            found[stamp] = line.fields[1:]
    if not found:
        lack = f'none of its {unreadable} lines is readable' if unreadable else 'it is empty'
        raise DatasetError(path, f'{lack}; looked for lines "{form}"',
                           'restore the file from the dataset')
    # Listed as `ls` does it, 99.9 comes after 100.0.
    stamps = sorted(found)
    return StampedList(np.array(stamps, np.int64), tuple(found[stamp] for stamp in stamps),
                       dropped, unreadable)


def read_tum_trajectory(path: Path) -> StampedPoses:
    """Ground truth as TUM writes it: stamp [s], position [m], quaternion xyzw of the camera."""
    rows = read_stamped_list(path, 'timestamp tx ty tz qx qy qz qw', 8)
    return poses_from_rows(path, rows, (3, 4, 5, 6))


def poses_from_rows(path: Path, rows: StampedList,
                    xyzw: tuple[int, int, int, int]) -> StampedPoses:
    """Position in columns 0 to 2 and quaternion in ``xyzw`` to poses; nan rows are left out."""
    try:
        numbers = np.array([row[:7] for row in rows.values], np.float64)
    except ValueError as error:
        raise DatasetError(path, f'holds something that is not a number ({error})',
                           'correct that line or restore the file') from error
    quaternion = numbers[:, list(xyzw)]
    usable = np.isfinite(numbers).all(1) & (np.linalg.norm(quaternion, axis=1) > 0.5)
    if not usable.any():
        raise DatasetError(path, 'holds no usable pose (all are nan or lack a rotation)',
                           'restore the file, or remove it to go without ground truth')
    rotation = sim3.rotation_from_quaternion(torch.from_numpy(quaternion[usable]))
    poses = sim3.from_parts(torch.ones(len(rotation)), rotation,
                            torch.from_numpy(numbers[usable, :3]))
    return StampedPoses(rows.stamps_ns[usable], poses.numpy())


def write_tum_trajectory(path: Path, poses: StampedPoses) -> None:
    """The counterpart of read_tum_trajectory, exact to the nanosecond and the micrometre."""
    T = torch.from_numpy(poses.T_world_cam)
    rows = torch.cat([sim3.translation_of(T), sim3.quaternion_of(sim3.rotation_of(T))], 1)
    text = ['# timestamp tx ty tz qx qy qz qw (camera-to-world)']
    for stamp, row in zip(poses.stamps_ns.tolist(), rows.tolist()):
        text.append(seconds_from_ns(stamp) + ''.join(f' {value:.8f}' for value in row))
    path.write_text('\n'.join(text) + '\n', encoding='utf-8')


def seconds_from_ns(stamp_ns: int) -> str:
    """Nanoseconds to decimal seconds, exactly."""
    return f'{stamp_ns // 1_000_000_000}.{stamp_ns % 1_000_000_000:09d}'
