"""Publish what a bag holds, as it was recorded. Needs no rosbag2."""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Sequence

from aim_slam_ros.cli.arguments import Refusal
from aim_slam_ros.cli.interrupts import INTERRUPTED, one_interrupt

if TYPE_CHECKING:
    from aim_slam_ros.nodes.replay.player import Player, Published

_CLOCK_HZ = 100.0
_WAIT_S = 30.0


def main(argv: Sequence[str] | None = None) -> int:
    """Exit status: 0 done, 2 refused, 130 interrupted."""
    given = list(sys.argv[1:] if argv is None else argv)
    own, for_ros = split_ros_arguments(given)
    try:
        args = _parser().parse_args(own)
        with one_interrupt():
            return _play(args, for_ros)
    except SystemExit as stop:      # argparse has said why
        return int(stop.code or 0)
    except Refusal as refusal:
        print(f'play: error: {refusal}', file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print('play: interrupted', file=sys.stderr)
        return INTERRUPTED


def split_ros_arguments(arguments: list[str]) -> tuple[list[str], list[str]]:
    """What stands outside and what inside of ``--ros-args ... [--]``."""
    own: list[str] = []
    for_ros: list[str] = []
    inside = False
    for argument in arguments:
        if inside and argument == '--':
            for_ros.append(argument)
            inside = False
            continue
        inside = inside or argument == '--ros-args'
        (for_ros if inside else own).append(argument)
    return own, for_ros


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='play', description=__doc__, allow_abbrev=False,
        epilog='Topics are published without their leading slash: /image as image, so that '
               '--ros-args -r __ns:=/robot makes it /robot/image and -r image:=camera/image_raw '
               'renames it. /tf, /tf_static and /clock keep their names. Publishers are reliable.')
    parser.add_argument('bag', metavar='BAG', type=Path,
                        help='a rosbag2 folder, a single .mcap or .db3, or a ROS 1 .bag')
    parser.add_argument('-r', '--rate', metavar='R', type=_positive, default=1.0,
                        help='times real time (default 1)')
    parser.add_argument('-l', '--loop', action='store_true',
                        help='begin again at the end, until Ctrl-C')
    parser.add_argument('--start-offset', metavar='S', type=_not_negative, default=0.0,
                        help='begin S seconds into the bag')
    parser.add_argument('--duration', '--playback-duration', metavar='S', type=_positive,
                        help='play S seconds of the bag')
    parser.add_argument('--clock', metavar='HZ', type=_positive, nargs='?', const=_CLOCK_HZ,
                        default=0.0, help='publish the time of the bag on /clock, for nodes with '
                                          f'use_sim_time (default {_CLOCK_HZ:g} times per second)')
    parser.add_argument('--wait', metavar='S', type=_not_negative, default=_WAIT_S,
                        help='how long to wait for a subscriber of the images; 0: begin at once '
                             f'(default {_WAIT_S:g})')
    parser.add_argument('--topics', metavar='TOPIC', nargs='+', default=[],
                        help='play these topics only')
    return parser


def _positive(text: str) -> float:
    value = _number(text)
    if not value > 0:
        raise argparse.ArgumentTypeError(f'{text!r} is not allowed; expected a number above 0')
    return value


def _not_negative(text: str) -> float:
    value = _number(text)
    if not value >= 0:
        raise argparse.ArgumentTypeError(f'{text!r} is not allowed; expected a number from 0 on')
    return value


def _number(text: str) -> float:
    """nan for what is not a finite number."""
    try:
        value = float(text)
    except ValueError:
        return math.nan
    return value if math.isfinite(value) else math.nan


def _play(args: argparse.Namespace, for_ros: list[str]) -> int:
    import rclpy

    from aim_slam_ros.datasets.base import DatasetError
    from aim_slam_ros.nodes.replay.player import PlayError
    _init(for_ros)
    try:
        _publish(args)
    except (DatasetError, PlayError) as error:
        raise Refusal(str(error)) from error
    finally:
        rclpy.try_shutdown()
    return 0


def _init(for_ros: list[str]) -> None:
    """Raises Refusal for ROS arguments that cannot be read."""
    import rclpy
    from rclpy.signals import SignalHandlerOptions
    try:
        rclpy.init(args=for_ros, signal_handler_options=SignalHandlerOptions.NO)
    except (RuntimeError, ValueError) as error:     # what rclpy makes of rcl's refusals
        reason = str(error).partition(', at /')[0].partition(' Error: error not set')[0]
        raise Refusal(f'the ROS arguments cannot be used: {reason}') from error


def _publish(args: argparse.Namespace) -> None:
    from rclpy.node import Node

    from aim_slam_ros.nodes.replay.player import Player, PlayOptions
    options = PlayOptions(args.rate, args.loop, args.start_offset, args.duration, args.clock,
                          tuple(args.topics))
    node = Node('player', start_parameter_services=False, enable_rosout=False)
    try:
        player = Player(node, args.bag.expanduser(), options)
        _introduce(player, args)
        if args.wait and player.image_topics:
            player.wait_for_subscriber(args.wait)
        _count(player)
        player.close()
    finally:
        node.destroy_node()


def _introduce(player: Player, args: argparse.Namespace) -> None:
    for topic, reason in player.left_out.items():
        print(f'{topic} is left out: {reason}')
    print(f'{args.bag}: {player.messages} messages, {player.images} of them images, in '
          f'{player.length_s:.1f} s')
    if args.wait and player.image_topics:
        print(f'waiting for a subscriber of {" or ".join(player.image_topics)}, at most '
              f'{args.wait:g} s', flush=True)


def _count(player: Player) -> None:
    """Play with a progress bar, and say what was sent."""
    from aim_slam_ros.cli.counting import counter
    by_image = player.images > 0
    with counter(player.images or player.messages, 'image' if by_image else 'message') as step:
        def count(published: Published) -> None:
            if published.is_image or not by_image:
                step()
        played = player.play(count)
    damaged = f'; {played.damaged} were damaged and left out' if played.damaged else ''
    print(f'sent {played.messages} messages, {played.images} of them images, at most '
          f'{played.late_max_ns / 1e6:.1f} ms late{damaged}')


if __name__ == '__main__':
    sys.exit(main())
