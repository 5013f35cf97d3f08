"""Find the sigmas that make kappa honest for a model and a tracker.

SIGMA widens a window while kappa, the reduced chi-square of what the model says, is above
sigma.kappa. That means something only where kappa is 1 for usual errors: which those are depends
on the model and on the tracker.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from typing import Sequence

from aim_slam_ros.cli.arguments import Refusal, assignment, configured
from aim_slam_ros.cli.image_choice import add_image_options, chosen, opened
from aim_slam_ros.cli.interrupts import INTERRUPTED
from aim_slam_ros.config import Config
from aim_slam_ros.settings import ConfigError

_FEWEST = 10    # windows that a median may be taken of


def main(argv: Sequence[str] | None = None) -> int:
    """Exit status: 0 done, 2 refused, 130 interrupted."""
    try:
        return _calibrate(_parser().parse_args(argv))
    except SystemExit as stop:      # argparse has said why
        return int(stop.code or 0)
    except Refusal as refusal:
        print(f'calibrate: error: {refusal}', file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print('calibrate: interrupted', file=sys.stderr)
        return INTERRUPTED


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='calibrate', description=__doc__, allow_abbrev=False,
        epilog='Prints the settings, as --set takes them. Windows stay as large as they start '
               '(sigma.min_window) meanwhile. No ground truth is needed.')
    parser.add_argument('datasets', metavar='DATASET', nargs='+',
                        help='datasets as evaluate takes them, of the kind that is to be tracked')
    parser.add_argument('--model', metavar='M', help='the geometry model (model.name)')
    parser.add_argument('--set', metavar='section.name=value', type=assignment, action='append',
                        default=[], dest='settings', help='change a setting; may be repeated')
    add_image_options(parser)
    return parser


def _calibrate(args: argparse.Namespace) -> int:
    short = [] if args.model is None else [('model.name', args.model)]
    config = configured(args.settings + short)
    kappas = [kappa for source in args.datasets for kappa in _kappas(source, args, config)]
    from aim_slam_ros.ablation.calibration import honest_sigmas, starting_views
    if len(kappas) < _FEWEST:
        raise Refusal(f'only {len(kappas)} windows had {starting_views(config)} views, too few '
                      'for a median: give more or longer datasets')
    for name, value in honest_sigmas(config, kappas).items():
        print(f'--set {name}={value}')
    return 0


def _kappas(source: str, args: argparse.Namespace, config: Config) -> list[float]:
    """Of one dataset, and a line about them."""
    sequence = opened(source, args)
    indices = chosen(sequence, args)

    from aim_slam_ros import offline
    from aim_slam_ros.ablation.calibration import kappas_of, unwidened
    from aim_slam_ros.datasets import DatasetError
    try:
        run = offline.run(sequence, unwidened(config), indices)
    except (ConfigError, DatasetError) as error:
        raise Refusal(str(error)) from error
    if run.interrupted:
        raise KeyboardInterrupt
    kappas = kappas_of(run.results, config)
    quartiles = ', '.join(f'{q:.3g}' for q in statistics.quantiles(kappas, n=4)) \
        if len(kappas) > 1 else 'too few'
    print(f'{sequence.name}: {len(kappas)} windows, quartiles of kappa {quartiles}',
          file=sys.stderr, flush=True)
    return kappas


if __name__ == '__main__':
    sys.exit(main())
