"""TF where it is installed, and where it is not.

The wheels of ROS 2 lack tf2_ros. What stands in for it here has its signatures (Jazzy), and
broadcasts for real: what another process would hear is what is looked at.
"""

from __future__ import annotations

import importlib.util
import signal
from pathlib import Path

import pytest
from ros_peer import Process
from tf_stand_in import STAND_IN

PROGRAM = """
import sys
import torch
from rclpy.node import Node
from aim_slam_ros.geometry import sim3
from aim_slam_ros.nodes.running import run
from aim_slam_ros.nodes.transforms import Transforms


class Probe(Node):
    def __init__(self):
        super().__init__('probe')
        transforms = Transforms(self)
        print('available', transforms.available)
        transforms.listen()
        T = sim3.exp(torch.tensor([1.0, 2.0, 3.0, 0.1, 0.2, 0.3, 0.0]).double())
        for stamp in (5, 6):
            transforms.send(T, stamp, 'map', 'odom')
            found = transforms.lookup('map', 'odom')
        print('found', None if found is None else bool(torch.allclose(found, T)))
        print('unknown', transforms.lookup('map', 'moon'), flush=True)

    def close(self):
        pass


sys.exit(run(Probe, sys.argv))
"""


def run(folder: Path) -> str:
    """The output of the program."""
    (folder / 'probe_transforms.py').write_text(PROGRAM)
    with Process(folder / 'log', 'probe_transforms') as process:
        process.says('unknown')
        process.signal(signal.SIGINT)
        assert process.ended() == 0
        return process.output


def test_with_tf(tmp_path: Path) -> None:
    (tmp_path / 'tf2_ros.py').write_text(STAND_IN)
    said = run(tmp_path)
    assert 'available True' in said and 'found True' in said and 'unknown None' in said
    assert said.count('sent') == 2 and 'sent 5 map odom' in said
    assert 'not installed' not in said


@pytest.mark.skipif(importlib.util.find_spec('tf2_ros') is not None, reason='tf2_ros is here')
def test_without_tf_nothing_is_sent_and_that_is_said_once(tmp_path: Path) -> None:
    said = run(tmp_path)
    assert 'available False' in said and 'found None' in said
    assert said.count('tf2_ros is not installed') == 1
