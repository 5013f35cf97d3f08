"""Run both pipelines over a recorded dataset and write what came out."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any, Sequence

from aim_slam_ros.cli.arguments import (Refusal, assignment, configured, settings_text,
                                        writable_folder)
from aim_slam_ros.cli.image_choice import add_image_options, chosen, opened
from aim_slam_ros.config import Config
from aim_slam_ros.settings import ConfigError

# torch and matplotlib take seconds to import: what needs them is imported in _evaluate, after the
# command line has been found good.

_INTERRUPTED = 130


def main(argv: Sequence[str] | None = None) -> int:
    """Exit status: 0 done, 2 refused, 130 interrupted or failed, what there was being written."""
    try:
        args = _parser().parse_args(argv)
        config = configured(_assignments(args))
        writable_folder(args.out)
        return _evaluate(args, config)
    except SystemExit as stop:      # argparse has said why
        return int(stop.code or 0)
    except Refusal as refusal:
        print(f'evaluate: error: {refusal}', file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print('evaluate: interrupted, nothing more is written', file=sys.stderr)
        return _INTERRUPTED


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='evaluate', description=__doc__, allow_abbrev=False,
        epilog='Writes trajectory.txt, keyframes.txt, map.ply, config.yaml, metrics.json and '
               'report.png. Ctrl-C ends the run early and writes what there is.')
    parser.add_argument('dataset', metavar='DATASET',
                        help='a TUM RGB-D folder, a EuRoC folder, a bag, a folder of images, a '
                             'video, rendered:room or rendered:corridor')
    parser.add_argument('--out', metavar='DIR', type=Path, required=True,
                        help='where the results go; files of an earlier run are replaced')
    parser.add_argument('--model', metavar='M', help='the geometry model (model.name)')
    add_image_options(parser)
    parser.add_argument('--set', metavar='section.name=value', type=assignment, action='append',
                        default=[], dest='settings', help='change a setting; may be repeated')
    parser.add_argument('--no-loop-closure', action='store_true')
    parser.add_argument('--seed', metavar='N', help='seed of every random choice')
    parser.add_argument('--list-settings', action=_ListSettings, nargs=0,
                        help='show every setting with its default and range, and exit')
    return parser


class _ListSettings(argparse.Action):
    """Like --help: answers and exits, whatever else is missing."""

    def __call__(self, parser: argparse.ArgumentParser, *unused: Any) -> None:
        print(settings_text())
        parser.exit()


def _assignments(args: argparse.Namespace) -> list[tuple[str, str]]:
    """--set and the options that are short for one; those win."""
    short = {'model.name': args.model, 'seed': args.seed,
             'loop_closure.enabled': 'false' if args.no_loop_closure else None}
    return args.settings + [(name, value) for name, value in short.items() if value is not None]


def _evaluate(args: argparse.Namespace, config: Config) -> int:
    sequence = opened(args.dataset, args)
    indices = chosen(sequence, args)

    from aim_slam_ros import offline
    from aim_slam_ros.cli.progress import progress_bar
    from aim_slam_ros.cli.results import write_results
    from aim_slam_ros.datasets import DatasetError
    with progress_bar(len(indices)) as progress:
        try:
            run = offline.run(sequence, config, indices, progress)
        except (ConfigError, DatasetError) as error:
            raise Refusal(str(error)) from error
    write_results(args.out, sequence, config, run)
    return _INTERRUPTED if run.interrupted else 0


if __name__ == '__main__':
    sys.exit(main())
