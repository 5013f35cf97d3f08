"""How a process of nodes begins and ends, with real signals."""

from __future__ import annotations

import signal
import time
from pathlib import Path
from typing import Callable

import pytest
from ros_peer import Process

HEAD = """
import hashlib, sys, threading, time
from rclpy.node import Node
from aim_slam_ros.nodes.running import run
from aim_slam_ros.settings import ConfigError


class Quiet(Node):
    def __init__(self, name='quiet'):
        super().__init__(name)
        self.create_timer(0.1, lambda: print(name, 'turns', flush=True))

    def close(self):
        print(self.get_name(), 'closed', flush=True)
"""
TAIL = '\nsys.exit(run(make, sys.argv))\n'
ONE = 'def make():\n    return Quiet()\n'
LIMIT_S = 3.0       # from Ctrl-C to the end

Start = Callable[..., Process]


@pytest.fixture
def start(tmp_path: Path) -> Start:
    """A program around ``make`` as a process."""
    def started(make: str, *arguments: str) -> Process:
        (tmp_path / 'program.py').write_text(HEAD + make + TAIL)
        return Process(tmp_path / 'log', 'program', *arguments)
    return started


def ends_in_time(process: Process, *signals: int) -> int:
    begin = time.monotonic()
    for number in signals:
        process.signal(number)
        time.sleep(0.05)    # two at once would be one
    status = process.ended()
    assert time.monotonic() - begin < LIMIT_S
    assert 'Traceback' not in process.output, process.output
    return status


@pytest.mark.parametrize('signals', [(signal.SIGINT,), (signal.SIGTERM,),
                                     (signal.SIGINT, signal.SIGINT),
                                     (signal.SIGTERM, signal.SIGINT, signal.SIGINT)])
def test_signals_end_it_once(start: Start, signals: tuple[int, ...]) -> None:
    with start(ONE) as process:
        process.says('quiet turns')
        assert ends_in_time(process, *signals) == 0
        assert process.output.count('quiet closed') == 1


def test_several_nodes_live_and_end_together(start: Start) -> None:
    with start('def make():\n    return [Quiet("one"), Quiet("two")]\n') as process:
        process.says('one turns')
        process.says('two turns')
        assert ends_in_time(process, signal.SIGINT) == 0
        assert 'one closed' in process.output and 'two closed' in process.output


@pytest.mark.parametrize('daemon', [True, False])
def test_a_thread_that_hangs_is_not_waited_for(start: Start, daemon: bool) -> None:
    make = ('def make():\n'
            f'    threading.Thread(target=time.sleep, args=(60,), daemon={daemon}).start()\n'
            '    return Quiet()\n')
    with start(make) as process:
        process.says('quiet turns')
        assert ends_in_time(process, signal.SIGINT) == 0


def test_a_callback_that_hangs_does_not_keep_it(start: Start) -> None:
    """In one long call, so that the handler in Python has to wait for it."""
    make = ('class Busy(Quiet):\n'
            '    def __init__(self):\n'
            '        super().__init__()\n'
            '        self.create_timer(0.3, self.hang)\n\n'
            '    def hang(self):\n'
            '        print("hangs", flush=True)\n'
            '        hashlib.scrypt(b"", salt=b"", n=2**14, r=8, p=2000, maxmem=2**30)\n\n\n'
            'make = Busy\n')
    with start(make) as process:
        process.says('hangs')
        assert ends_in_time(process, signal.SIGINT) == 0


def test_what_a_callback_raises_is_told_and_is_no_success(start: Start) -> None:
    """Before nodes are closed: two of them may take the time that there is."""
    make = ('class Slow(Quiet):\n'
            '    def close(self):\n'
            '        time.sleep(1.2)\n\n\n'
            'class Broken(Slow):\n'
            '    def __init__(self):\n'
            '        super().__init__("broken")\n'
            '        self.create_timer(0.3, lambda: 1 / 0)\n\n\n'
            'def make():\n'
            '    return [Slow(), Broken()]\n')
    with start(make) as process:
        assert process.ended() == 1
        assert 'ZeroDivisionError' in process.output


def test_it_can_be_ended_while_it_is_made(start: Start) -> None:
    """Loading weights takes long."""
    make = 'def make():\n    print("loads", flush=True)\n    time.sleep(60)\n    return Quiet()\n'
    with start(make) as process:
        process.says('loads')
        assert ends_in_time(process, signal.SIGINT, signal.SIGINT) == 0


def test_a_wrong_setting_is_one_line(start: Start) -> None:
    with start('def make():\n    raise ConfigError("width: 3 is not allowed")\n') as process:
        assert process.ended() == 2
        assert process.output == 'error: width: 3 is not allowed\n'


@pytest.mark.parametrize('arguments, said', [
    (['-p', 'nonsense'], "'-p nonsense'"), (['--params-file', '/no.yaml'], '/no.yaml'),
    (['--nonsense'], '--nonsense'), (['-p', 'use_sim_time:=3'], 'use_sim_time')])
def test_wrong_ros_arguments_are_one_line(start: Start, arguments: list[str], said: str) -> None:
    with start(ONE, '--ros-args', *arguments) as process:
        assert process.ended() == 2
        lines = [line for line in process.output.splitlines() if 'rcl]' not in line]
        assert len(lines) == 1 and lines[0].startswith('error: ') and said in lines[0]


def test_a_wrong_quality_of_service_is_one_line(start: Start) -> None:
    make = ('from rclpy.qos_overriding_options import QoSOverridingOptions\n'
            'from std_msgs.msg import Empty\n\n\n'
            'def make():\n'
            '    node = Quiet()\n'
            '    node.create_publisher(Empty, "news", 1, qos_overriding_options=\n'
            '                          QoSOverridingOptions.with_default_policies())\n'
            '    return node\n')
    wrong = 'qos_overrides./news.publisher.reliability:=somewhat'
    with start(make, '--ros-args', '-p', wrong) as process:
        assert process.ended() == 2
        assert process.output.startswith('error: qos_overrides: ')
        assert '`reliability`: `somewhat`' in process.output


def test_an_error_of_ours_is_not_hidden(start: Start) -> None:
    make = ('class Broken(Quiet):\n'
            '    def __init__(self):\n'
            '        super().__init__()\n'
            '        self.create_timer(0.1, lambda: 1 / 0)\n\n\n'
            'make = Broken\n')
    with start(make) as process:
        assert process.ended() == 1
        assert 'ZeroDivisionError' in process.output and 'quiet closed' in process.output
