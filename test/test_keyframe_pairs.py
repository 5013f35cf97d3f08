"""Two messages make a keyframe, in whatever order they come."""

from __future__ import annotations

from sensor_msgs.msg import PointCloud2

from aim_slam_ros.nodes.loop_closure.keyframe_pairs import KeyframePairs


def message(second: int) -> PointCloud2:
    out = PointCloud2()
    out.header.stamp.sec = second
    return out


def test_equal_stamps_belong_together() -> None:
    pairs = KeyframePairs()
    first, second = message(1), message(2)
    assert pairs.table(first) is None and pairs.cloud(second) is None
    cloud, table = message(1), message(2)
    found = pairs.cloud(cloud)
    assert found is not None and found.table is first and found.cloud is cloud
    found = pairs.table(table)
    assert found is not None and found.table is table and found.cloud is second


def test_a_resent_message_takes_the_place_of_the_first() -> None:
    pairs = KeyframePairs()
    again = message(1)
    assert pairs.table(message(1)) is None and pairs.table(again) is None
    found = pairs.cloud(message(1))
    assert found is not None and found.table is again
    assert pairs.cloud(message(1)) is None, 'each is used once'


def test_few_wait_and_the_oldest_are_given_up() -> None:
    pairs = KeyframePairs()
    for second in range(100):
        assert pairs.table(message(second)) is None
    assert pairs.unpaired == 90
    assert pairs.cloud(message(89)) is None and pairs.cloud(message(90)) is not None


def test_what_an_earlier_telling_left_over_is_not_of_a_later_one() -> None:
    """The first cloud was lost; the keyframe is told again, the cloud first."""
    now = [0.0]
    pairs = KeyframePairs(lambda: now[0])
    assert pairs.table(message(1)) is None
    now[0] = 20.0
    cloud, table = message(1), message(1)
    assert pairs.cloud(cloud) is None and pairs.unpaired == 1
    now[0] = 20.1
    found = pairs.table(table)
    assert found is not None and found.table is table and found.cloud is cloud
