"""Which images of a dataset a command works on."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Sequence

from aim_slam_ros.cli.arguments import Refusal, selection, whole_number

if TYPE_CHECKING:
    from aim_slam_ros.datasets.base import Sequence as Recording


def add_image_options(parser: argparse.ArgumentParser) -> None:
    """--start, --count, --stride, --with-depth and --undistort."""
    parser.add_argument('--stride', metavar='K', type=whole_number(1), default=1,
                        help='take every K-th image (default 1)')
    parser.add_argument('--start', metavar='S', type=whole_number(0), default=0,
                        help='the first image, counted from 0')
    parser.add_argument('--count', metavar='N', type=whole_number(1),
                        help='look at the N images from the first one on, before --stride')
    parser.add_argument('--with-depth', action='store_true',
                        help='take only images that have depth (and a true pose, where the '
                             'dataset has ground truth), as the simulated model needs; '
                             '--stride counts those')
    parser.add_argument('--undistort', action='store_true',
                        help='remove lens distortion from the images; needs a calibration')


def opened(source: str, args: argparse.Namespace) -> Recording:
    """The dataset, with what --undistort says; raises Refusal."""
    from aim_slam_ros.datasets import DatasetError, load_sequence
    try:
        return load_sequence(source, undistort=args.undistort)
    except DatasetError as error:
        raise Refusal(str(error)) from error


def chosen(sequence: Recording, args: argparse.Namespace) -> Sequence[int]:
    """The indices that the options ask for; raises Refusal where there are none."""
    indices: Sequence[int] = selection(len(sequence), args.start, args.count, 1)
    if args.with_depth:
        from aim_slam_ros.recorded_truth import RecordedTruth
        indices = RecordedTruth(sequence).with_depth(indices)
        if not indices:
            raise Refusal(f'{sequence.name}: none of these images has depth (and a true pose, '
                          'where there is ground truth): leave --with-depth out, choose others '
                          'with --start and --count, or take another dataset')
    return indices[::args.stride]
