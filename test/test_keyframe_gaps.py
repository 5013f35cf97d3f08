"""Keyframes that were lost on the way are asked for, but not all the time."""

from __future__ import annotations

from aim_slam_ros.nodes.loop_closure.keyframe_gaps import KeyframeGaps


def gaps_of(*received: int) -> KeyframeGaps:
    gaps = KeyframeGaps(patience_s=2.0)
    for keyframe_id in received:
        gaps.received(keyframe_id)
    return gaps


def asked_at(gaps: KeyframeGaps, until_s: int) -> list[int]:
    """Looked at once a second."""
    return [second for second in range(until_s) if gaps.overdue(float(second))]


def test_without_a_gap_nothing_is_asked() -> None:
    assert asked_at(gaps_of(0, 1, 2), 100) == []
    assert asked_at(gaps_of(1, 0), 100) == [], 'the order does not matter'
    assert asked_at(gaps_of(), 100) == []


def test_a_gap_may_be_open_for_a_while() -> None:
    gaps = gaps_of(0, 2)
    assert gaps.missing == 1
    assert not gaps.overdue(0.0) and not gaps.overdue(1.9) and gaps.overdue(2.0)


def test_asking_in_vain_becomes_rare() -> None:
    assert asked_at(gaps_of(0, 2), 100) == [2, 6, 14, 30, 62]


def test_while_they_are_being_sent_again_it_waits() -> None:
    """A frontend with many keyframes sends them for minutes, the known ones too."""
    gaps = gaps_of(0, 1, 2, 50)
    for second in range(50):
        gaps.received(second % 3)
        assert not gaps.overdue(float(second))
    assert not gaps.overdue(50.9) and gaps.overdue(51.0)


def test_new_keyframes_do_not_hide_a_lost_one() -> None:
    gaps = gaps_of(0, 2)
    asked = []
    for second in range(5):
        gaps.received(3 + second)
        asked += [second] if gaps.overdue(float(second)) else []
    assert asked == [2]


def test_better_keyframes_do_not_hide_a_lost_one() -> None:
    gaps = gaps_of(0, 2)
    asked = []
    for second in range(5):
        gaps.received(0, better=True)
        asked += [second] if gaps.overdue(float(second)) else []
    assert asked == [2]


def test_a_closed_gap_is_forgotten() -> None:
    gaps = gaps_of(0, 2)
    assert asked_at(gaps, 10) == [2, 6]
    gaps.received(1)
    assert not gaps.overdue(10.0)
    gaps.received(4)
    assert not gaps.overdue(20.0) and gaps.overdue(22.0), 'as patient as at first'


def test_what_others_mention_exists() -> None:
    gaps = gaps_of(0)
    gaps.exists(1)
    assert gaps.missing == 1 and asked_at(gaps, 3) == [2]
