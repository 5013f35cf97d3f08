"""Published after changes, but neither too often nor at too great a cost."""

from __future__ import annotations

import time

from ros_peer import wait_for

from aim_slam_ros.nodes.loop_closure.pacer import Pacer


def spend(pacer: Pacer, cost_s: float) -> None:
    pacer.begin()
    time.sleep(cost_s)
    pacer.end()


def test_only_what_changed_is_due_and_the_first_time_at_once() -> None:
    pacer = Pacer(period_s=60.0)
    assert not pacer.due()
    pacer.change()
    assert pacer.due() and not pacer.due(grace_s=10 ** 9)
    spend(pacer, 0.0)
    assert not pacer.due()
    pacer.change()
    assert not pacer.due(), 'the period is not over'


def test_a_change_meanwhile_is_for_the_next_time() -> None:
    pacer = Pacer(period_s=0.05)
    pacer.change()
    pacer.begin()
    pacer.change()
    pacer.end()
    wait_for(pacer.due, 'the end of the period', timeout_s=5.0)


def test_what_costs_much_is_rare() -> None:
    """A quarter of the time at most."""
    pacer = Pacer(period_s=0.0)
    begin = time.monotonic()
    pacer.change()
    spend(pacer, 0.05)
    pacer.change()
    wait_for(pacer.due, 'its turn', timeout_s=5.0)
    assert time.monotonic() - begin >= 4 * 0.05
