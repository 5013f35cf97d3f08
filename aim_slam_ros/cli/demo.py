"""Play a dataset or a bag to both nodes, two processes over DDS, and write what they publish."""

from __future__ import annotations

import argparse
import dataclasses
import math
import os
import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Sequence

from aim_slam_ros.cli.arguments import (Refusal, assignment, configured, selection, whole_number,
                                        writable_folder)
from aim_slam_ros.cli.interrupts import INTERRUPTED, one_interrupt
from aim_slam_ros.config import Config

if TYPE_CHECKING:
    from aim_slam_ros.datasets.bag_sequence import BagSequence
    from aim_slam_ros.nodes.demo.live_run import LiveResult

# On two cores the classical model follows 30 images a second, but not while the player and loop
# closure work beside it: at real time a third of the images was dropped, at this rate 1 to 3 %.
_RATE = 0.3
_DEFAULT = 'rendered:room'
_FAILED = 1
_BAG = 'bag'


def main(argv: Sequence[str] | None = None) -> int:
    """Exit status: 0 done, 1 nothing was tracked or a node died, 2 refused, 130 interrupted (with
    everything until then written)."""
    try:
        args = _parser().parse_args(argv)
        config = configured(_assignments(args))
        writable_folder(args.out)
        if args.keep_bag and (args.out / _BAG).exists():
            raise Refusal(f'--keep-bag: {args.out / _BAG} exists; remove it or name another --out')
        with one_interrupt():
            return _demo(args, config)
    except SystemExit as stop:      # argparse has said why
        return int(stop.code or 0)
    except Refusal as refusal:
        _say(f'error: {refusal}')
        return 2
    except KeyboardInterrupt:
        _say('interrupted, nothing more is written')
        return INTERRUPTED


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='demo', description=__doc__, allow_abbrev=False,
        epilog='Writes what evaluate writes, from the topics alone, with the images that were '
               'dropped and the latency from image to pose; besides parameters.yaml and the logs '
               'of both nodes. Ctrl-C ends the run early and writes what there is.')
    parser.add_argument('dataset', metavar='DATASET', nargs='?', default=_DEFAULT,
                        help=f'what evaluate takes, or a bag (default {_DEFAULT})')
    parser.add_argument('--out', metavar='DIR', type=Path, required=True,
                        help='where the results go; files of an earlier run are replaced')
    parser.add_argument('--model', metavar='M', help='the geometry model (model.name)')
    parser.add_argument('--rate', metavar='R', type=_rate, default=_RATE,
                        help='times real time (default %(default)s: what two cores manage with '
                             'images at 30 Hz)')
    parser.add_argument('--stride', metavar='K', type=whole_number(1), default=1,
                        help='take every K-th image (default 1)')
    parser.add_argument('--start', metavar='S', type=whole_number(0), default=0,
                        help='the first image, counted from 0')
    parser.add_argument('--count', metavar='N', type=whole_number(1),
                        help='look at the N images from the first one on, before --stride')
    parser.add_argument('--set', metavar='section.name=value', type=assignment, action='append',
                        default=[], dest='settings', help='change a setting; may be repeated')
    parser.add_argument('--keep-bag', action='store_true',
                        help=f'leave the bag that was made of the dataset in DIR/{_BAG}')
    return parser


def _rate(text: str) -> float:
    """An argparse type."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.01 <= value <= 100.0:
        raise argparse.ArgumentTypeError(
            f'{text!r} is not allowed; expected a number from 0.01 to 100')
    return value


def _assignments(args: argparse.Namespace) -> list[tuple[str, str]]:
    return args.settings + ([('model.name', args.model)] if args.model else [])


def _demo(args: argparse.Namespace, config: Config) -> int:
    # torch, rclpy and matplotlib take seconds to import.
    from aim_slam_ros.cli.live_progress import live_progress
    from aim_slam_ros.cli.results import write_results
    from aim_slam_ros.datasets import DatasetError
    from aim_slam_ros.nodes.demo.live_run import LiveBag, run_live
    from aim_slam_ros.nodes.replay.player import PlayError
    try:
        bag = _bag(args)
        _join_free_domain()
        with live_progress(len(bag)) as listener:
            result = run_live(LiveBag(bag.path, bag.topics), dataclasses.asdict(config), args.out,
                              args.rate, listener)
    except (DatasetError, PlayError) as error:
        raise Refusal(str(error)) from error
    write_results(args.out, bag, config, result.run)
    return _status(result, args.out)


def _bag(args: argparse.Namespace) -> BagSequence:
    """The dataset as a bag; raises Refusal and DatasetError."""
    from aim_slam_ros.cli.bag_cache import cached_bag
    from aim_slam_ros.datasets import load_sequence
    from aim_slam_ros.datasets.bag_sequence import BagSequence
    sequence = load_sequence(args.dataset)
    indices = selection(len(sequence), args.start, args.count, args.stride)
    if isinstance(sequence, BagSequence) and len(indices) == len(sequence):
        return sequence
    path = cached_bag(args.dataset, sequence, indices)
    if args.keep_bag:
        _keep(path, args.out / _BAG)
    bag = BagSequence(path)
    bag.name = sequence.name
    shift_ns = int(bag.stamps_ns[0] - sequence.stamps_ns[indices[0]])
    if shift_ns and len(bag) == len(indices):   # else the first image was not readable
        _say(f'all stamps moved by {shift_ns / 1e9:g} s: 0 is no time in ROS')
    return bag


def _keep(bag: Path, copy: Path) -> None:
    """Raises Refusal."""
    try:
        shutil.copytree(bag, copy)
    except OSError as error:
        raise Refusal(f'--keep-bag: {copy} cannot be written ({error.strerror or error})'
                      ) from error
    _say(f'the bag is kept in {copy}')


def _join_free_domain() -> None:
    """Meet nobody else's nodes; raises Refusal."""
    from aim_slam_ros.nodes.demo.domains import NoFreeDomain, free_domain
    try:
        os.environ['ROS_DOMAIN_ID'] = str(free_domain())
    except NoFreeDomain as error:
        raise Refusal(str(error)) from error
    reach = os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    _say(f'to look on: ROS_DOMAIN_ID={os.environ["ROS_DOMAIN_ID"]} '
         f'ROS_AUTOMATIC_DISCOVERY_RANGE={reach}')


def _status(result: LiveResult, out: Path) -> int:
    for problem in result.problems:
        _say(problem)
    if result.failure is not None:
        _say(f'error: {result.failure}')
        return _FAILED
    if result.run.interrupted:
        return INTERRUPTED
    if not result.run.tracked:
        _say(f'error: no image was tracked; {out / "frontend.log"} may tell why')
        return _FAILED
    return 0


def _say(text: str) -> None:
    print(f'demo: {text}', file=sys.stderr, flush=True)


if __name__ == '__main__':
    sys.exit(main())
