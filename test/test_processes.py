"""Processes of the operating system: how they are started, watched and ended."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Callable

import pytest

from aim_slam_ros.nodes.demo import domains
from aim_slam_ros.nodes.demo.processes import NodeProcess, executable, stop

ROOT = Path(__file__).resolve().parents[1]
TIMEOUT_S = 20.0
POLITE = 'import time; print("ready", flush=True); time.sleep(60)'
STUBBORN = 'import signal; signal.signal(signal.SIGINT, signal.SIG_IGN); ' + POLITE
DYING = 'print("no weights", flush=True); raise SystemExit(4)'


def wait_for(condition: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + TIMEOUT_S
    while not condition():
        assert time.monotonic() < deadline_s, 'it did not come'
        time.sleep(0.01)


def started(script: str, folder: Path, name: str = 'node') -> NodeProcess:
    return NodeProcess(name, [sys.executable, '-c', script], folder / f'{name}.log', os.environ)


def ready(*processes: NodeProcess) -> None:
    wait_for(lambda: all('ready' in process.tail() for process in processes))


def test_a_node_ends_with_one_signal(tmp_path: Path) -> None:
    quiet = POLITE.replace('time.sleep(60)', 'signal.sigwait([signal.SIGINT])')
    script = f'import signal; signal.pthread_sigmask(0, [signal.SIGINT]); {quiet}'
    process = started(script, tmp_path)
    ready(process)
    assert process.alive and process.code is None
    ended, = stop([process])
    assert ended.code == 0 and not ended.killed and ended.problem is None
    assert not process.alive
    assert stop([process]) == (ended,)      # once more changes nothing


def test_a_node_that_does_not_end_is_killed_and_said(tmp_path: Path) -> None:
    """The other one is told to end at the same time, and does not pay for it."""
    stubborn, polite = started(STUBBORN, tmp_path, 'stubborn'), started(POLITE, tmp_path, 'polite')
    ready(stubborn, polite)
    begun_s = time.monotonic()
    ended = stop([stubborn, polite], grace_s=1.0)
    assert time.monotonic() - begun_s < 5.0     # 1 s, and what a busy machine adds
    assert ended[0].killed and ended[0].code == -signal.SIGKILL
    assert 'stubborn did not end' in str(ended[0].problem)
    assert not ended[1].killed
    # Python's own answer to SIGINT is a traceback
    assert 'polite left a traceback' in str(ended[1].problem)


def test_a_node_that_dies_leaves_its_last_words(tmp_path: Path) -> None:
    process = started(DYING, tmp_path)
    wait_for(lambda: not process.alive)
    assert process.code == 4 and process.tail() == 'no weights'
    ended, = stop([process])
    assert 'ended with status 4' in str(ended.problem) and str(process.log) in str(ended.problem)


def test_nodes_do_not_outlive_who_started_them(tmp_path: Path) -> None:
    """Killed, the parent can tell nobody."""
    script = ('import os, sys, time; from pathlib import Path; '
              'from aim_slam_ros.nodes.demo.processes import NodeProcess; '
              'p = NodeProcess("child", [sys.executable, "-c", "import os, time; '
              'print(os.getpid(), flush=True); time.sleep(60)"], Path(sys.argv[1]), os.environ); '
              'time.sleep(60)')
    log = tmp_path / 'child.log'
    parent = subprocess.Popen([sys.executable, '-c', script, str(log)],
                              env=os.environ | {'PYTHONPATH': str(ROOT)})
    wait_for(lambda: log.exists() and log.read_text().endswith('\n'))
    child = int(log.read_text())
    parent.kill()
    parent.wait()
    wait_for(lambda: not _runs(child))


def _runs(pid: int) -> bool:
    """Whether it is there and no zombie, which waits for nobody who would take it in."""
    try:
        state = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()[0]
    except FileNotFoundError:
        return False
    return state != 'Z'


def test_the_executables_beside_the_program_are_taken(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As colcon lays them out; in the sources it is the module."""
    monkeypatch.setattr(sys, 'argv', [str(ROOT / 'aim_slam_ros' / 'cli' / 'demo.py')])
    assert executable('frontend')[1:] == ['-m', 'aim_slam_ros.cli.frontend']
    beside = tmp_path / 'lib' / 'aim_slam_ros'
    beside.mkdir(parents=True)
    (beside / 'frontend').touch()
    monkeypatch.setattr(sys, 'argv', [str(beside / 'demo')])
    assert executable('frontend') == [sys.executable, str(beside / 'frontend')]
    assert executable('loop_closure')[1:] == ['-m', 'aim_slam_ros.cli.loop_closure']


def test_a_domain_with_a_participant_is_not_free(monkeypatch: pytest.MonkeyPatch) -> None:
    """DDS gives the first participant of domain d port 7410 + 250 d, the second 7412 + 250 d."""
    monkeypatch.setattr(domains, '_DOMAINS', range(90, 92))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as participant:
        participant.bind(('', 7412 + 250 * 90))
        assert {domains.free_domain() for _ in range(5)} == {91}
        monkeypatch.setattr(domains, '_DOMAINS', range(90, 91))
        with pytest.raises(domains.NoFreeDomain, match='end other ROS programs'):
            domains.free_domain()
