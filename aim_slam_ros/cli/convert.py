"""Write a dataset, a video or a ROS 1 bag as a rosbag2."""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Sequence

from aim_slam_ros.cli.arguments import Refusal, selection, whole_number
from aim_slam_ros.cli.interrupts import INTERRUPTED, one_interrupt

if TYPE_CHECKING:
    from aim_slam_ros.datasets.bag_writing import WrittenBag

_STORAGES = ('mcap', 'sqlite3')
_SHOWN = 10
_TOPIC = re.compile(r'(/[A-Za-z_][A-Za-z0-9_]*)+')


def main(argv: Sequence[str] | None = None) -> int:
    """Exit status: 0 done, 2 refused, 130 interrupted (and nothing written)."""
    try:
        args = _parser().parse_args(argv)
        with one_interrupt():
            return _convert(args)
    except SystemExit as stop:      # argparse has said why
        return int(stop.code or 0)
    except Refusal as refusal:
        print(f'convert: error: {refusal}', file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print('convert: interrupted, nothing is written', file=sys.stderr)
        return INTERRUPTED


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='convert', description=__doc__, allow_abbrev=False,
        epilog='Topics: /image (sensor_msgs/Image), /camera_info where the camera is calibrated, '
               'and /groundtruth (geometry_msgs/PoseStamped of the optical frame of the camera, '
               'in the frame that the dataset has) where there is one. Messages are recorded at '
               'the times of their stamps. Other topics of a bag are left out.')
    parser.add_argument('source', metavar='SOURCE',
                        help='a TUM RGB-D folder, a EuRoC folder, a folder of images, a video, a '
                             'ROS 1 or ROS 2 bag, rendered:room or rendered:corridor')
    parser.add_argument('out', metavar='OUT', type=Path, help='the folder of the new bag')
    parser.add_argument('--storage', choices=_STORAGES, default='mcap',
                        help='form of the bag (default mcap)')
    parser.add_argument('--start', metavar='S', type=whole_number(0), default=0,
                        help='the first image, counted from 0')
    parser.add_argument('--count', metavar='N', type=whole_number(1),
                        help='look at the N images from the first one on, before --stride')
    parser.add_argument('--stride', metavar='K', type=whole_number(1), default=1,
                        help='take every K-th image (default 1)')
    parser.add_argument('--undistort', action='store_true',
                        help='remove lens distortion from the images; needs a calibration')
    parser.add_argument('--compressed', action='store_true',
                        help='write JPEG images (/image/compressed): small, but not exact')
    parser.add_argument('--image-topic', metavar='NAME', type=_topic, default='/image',
                        help='topic of the images; camera_info stands beside it (default image)')
    parser.add_argument('--topic', metavar='NAME', help='the images of a bag as SOURCE; short for '
                                                        'SOURCE?topic=NAME')
    parser.add_argument('--force', action='store_true', help='replace OUT where it is a bag')
    return parser


def _topic(text: str) -> str:
    """An argparse type: a topic, made absolute."""
    topic = f'/{text.removeprefix("/")}'
    if not _TOPIC.fullmatch(topic) or topic == '/groundtruth' or topic.endswith('/camera_info'):
        raise argparse.ArgumentTypeError(
            f'{text!r} is not allowed; expected a topic as image or camera/image_raw')
    return topic


def _convert(args: argparse.Namespace) -> int:
    _check_out(args.out, args.force)
    from aim_slam_ros.cli.counting import counter
    from aim_slam_ros.datasets import DatasetError, load_sequence
    from aim_slam_ros.datasets.bag_writing import BagForm, write_bag
    source = f'{args.source}?topic={args.topic}' if args.topic else args.source
    try:
        sequence = load_sequence(source, undistort=args.undistort)
        indices = selection(len(sequence), args.start, args.count, args.stride)
        form = BagForm(args.storage, args.image_topic, args.compressed)
        with counter(len(indices), 'image') as progress:
            written = write_bag(sequence, indices, args.out, form, progress=progress)
    except DatasetError as error:
        raise Refusal(str(error)) from error
    _tell(args.out, written)
    return 0


def _check_out(out: Path, force: bool) -> None:
    """Nothing but a bag is ever replaced; raises Refusal."""
    if not out.exists():
        return
    if not (out / 'metadata.yaml').exists() or not all(
            file.suffix in ('.mcap', '.db3', '.yaml') for file in out.iterdir()):
        raise Refusal(f'{out} exists and is not just a bag; name another folder, or remove it')
    if not force:
        raise Refusal(f'{out} exists; name another folder, or replace it with --force')


def _tell(out: Path, written: WrittenBag) -> None:
    for error in written.unreadable[:_SHOWN]:
        print(f'skipped {error}')
    if len(written.unreadable) > _SHOWN:
        print(f'skipped {len(written.unreadable) - _SHOWN} more')
    if written.shift_ns:
        print(f'all stamps moved by {written.shift_ns / 1e9:g} s: 0 is no time in ROS')
    truth = f'{written.poses} poses' if written.poses else 'none'
    print(f'{written.images} images, {"with" if written.camera_infos else "without"} camera_info, '
          f'ground truth: {truth}')
    print(out)


if __name__ == '__main__':
    sys.exit(main())
