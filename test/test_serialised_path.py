"""The path made at once is the path made pose by pose."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from nav_msgs.msg import Path
from rclpy.serialization import deserialize_message

from aim_slam_ros.geometry import sim3
from msg_adapters import poses
from msg_adapters.errors import MessageError
from msg_adapters.serialised_path import serialised_path

STAMP_NS = 1_700_000_000_123_456_789


@pytest.mark.parametrize('frame_id', ['map', 'm', 'ma', 'robot', 'a/longer/map', 'seven77', ''])
@pytest.mark.parametrize('count', [0, 1, 2, 5])
def test_it_reads_as_the_message_does(count: int, frame_id: str) -> None:
    """Every alignment of the name, with no pose, the first, and those after it."""
    torch.manual_seed(count)
    Ts = sim3.exp(torch.randn(count, 7).double()).numpy()
    stamps_ns = STAMP_NS + 33_000_000 * np.arange(count)
    expected = poses.path(stamps_ns, Ts, frame_id)
    expected.header.frame_id = frame_id
    assert deserialize_message(serialised_path(stamps_ns, Ts, frame_id), Path) == expected


def test_numbers_that_are_no_pose_are_refused() -> None:
    T = np.eye(4)[None].repeat(2, 0)
    with pytest.raises(MessageError, match='stamp'):
        serialised_path(np.array([0, 2 ** 62]), T, 'map')
    T[1, 0, 3] = np.nan
    with pytest.raises(MessageError, match='finite'):
        serialised_path(np.array([0, 1]), T, 'map')
