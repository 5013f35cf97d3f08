"""Compare settings, and the model's own poses, over sequences and seeds."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Sequence

from aim_slam_ros.ablation.plan import Plan
from aim_slam_ros.ablation.processes import cores, run_all
from aim_slam_ros.ablation.runs import Images, Run, RunFolder
from aim_slam_ros.ablation.variants import (Comparison, Preset, VariantError, parsed_variant,
                                            read_preset)
from aim_slam_ros.cli.arguments import Refusal, assignment, whole_number, writable_folder
from aim_slam_ros.cli.image_choice import add_image_options, chosen, opened
from aim_slam_ros.cli.interrupts import INTERRUPTED, one_interrupt
from aim_slam_ros.config import ConfigError

# torch takes seconds to import: what needs it is imported after the command line has been found
# good.

_FAILED = 1
_EPILOG = """
A variant is NAME:section.key=value,section.key=value. With method=chain or method=pose_mean among
them it is no SLAM but the model's own poses, chained from image to image or averaged over the
keyframes of a window. A preset is a YAML file of variants, as benchmark/ablations.yaml. Finished
runs are kept in DIR/runs and not done again: take a new DIR when the code, a recording or
the weights have changed. The tables are printed and written to DIR/tables.md. Rates are of runs
beside each other.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Exit status: 0 done, 1 some runs failed, 2 refused, 130 interrupted."""
    try:
        args = _parser().parse_args(argv)
        with one_interrupt():
            return _ablate(args)
    except SystemExit as stop:      # argparse has said why
        return int(stop.code or 0)
    except (Refusal, VariantError, ConfigError) as refusal:
        print(f'ablate: error: {refusal}', file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print('ablate: interrupted; the same command goes on from here', file=sys.stderr)
        return INTERRUPTED


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog='ablate', description=__doc__, epilog=_EPILOG,
                                     allow_abbrev=False)
    parser.add_argument('--sequences', metavar='DATASET', nargs='+', required=True,
                        help='datasets as evaluate takes them')
    parser.add_argument('--variant', metavar='NAME:SETTINGS', action='append', default=[],
                        dest='variants', help='may be repeated')
    parser.add_argument('--preset', metavar='FILE', type=Path, help='variants from a file')
    parser.add_argument('--out', metavar='DIR', type=Path, required=True)
    parser.add_argument('--seeds', metavar='N', type=whole_number(1), default=5,
                        help='how many seeds, from 0 on (default 5)')
    parser.add_argument('--jobs', metavar='N', type=whole_number(1), default=cores(),
                        help='runs at a time (default: one for each core)')
    parser.add_argument('--model', metavar='M', help='the geometry model (model.name)')
    parser.add_argument('--set', metavar='section.name=value', type=assignment, action='append',
                        default=[], dest='settings', help='for all variants; may be repeated')
    parser.add_argument('--also', metavar='METRIC', nargs='+', default=[],
                        help='more of what metrics.json holds, a column each')
    add_image_options(parser)
    return parser


def _ablate(args: argparse.Namespace) -> int:
    preset = _preset(args)
    settings = {**preset.settings, **dict(args.settings)}
    if args.model is not None:
        settings['model.name'] = args.model
    Plan(preset.comparisons, settings, {}, args.seeds)     # refuses what is wrong, before the work
    folder = RunFolder(writable_folder(args.out) / 'runs')
    plan = Plan(preset.comparisons, settings, _images(args), args.seeds)
    failed = _finish(plan, folder, args.jobs)
    tables = plan.tables(folder, tuple(args.also))
    (args.out / 'tables.md').write_text(tables, encoding='utf-8')
    print(tables, end='')
    return _FAILED if failed else 0


def _preset(args: argparse.Namespace) -> Preset:
    """The variants of the file and of the command line."""
    preset = read_preset(args.preset) if args.preset else Preset({}, ())
    if not (args.variants or args.preset):
        raise Refusal('nothing to compare: give --preset FILE or --variant NAME:SETTINGS')
    typed = tuple(parsed_variant(text) for text in args.variants)
    named = Comparison('Variants', typed)
    return Preset(preset.settings, preset.comparisons + ((named,) if typed else ()))


def _images(args: argparse.Namespace) -> dict[str, Images]:
    """By the name of the sequence, or by what was typed where two have the same name."""
    recordings = [opened(source, args) for source in args.sequences]
    names = [recording.name for recording in recordings]
    return {name if names.count(name) == 1 else source:
            Images(_absolute(source), tuple(chosen(recording, args)), args.undistort)
            for source, name, recording in zip(args.sequences, names, recordings)}


def _absolute(source: str) -> str:
    """A path wherever it is named from; other sources as they are."""
    path = Path(source).expanduser()
    return str(path.resolve()) if path.exists() else source


def _finish(plan: Plan, folder: RunFolder, jobs: int) -> int:
    """Do what has not been done; how many runs failed."""
    missing = [run for run in plan.runs() if folder.figures(run) is None]
    ended, failed = 0, 0
    start = time.monotonic()

    def finished(run: Run, status: int) -> None:
        nonlocal ended, failed
        ended, failed = ended + 1, failed + (status != 0)
        outcome = _outcome(folder, run) if status == 0 else f'failed with exit status {status}'
        print(f'{ended}/{len(missing)} after {time.monotonic() - start:.0f} s: '
              f'{plan.described(run)}: {outcome}', file=sys.stderr, flush=True)

    run_all(missing, folder, jobs, finished)
    return failed


def _outcome(folder: RunFolder, run: Run) -> str:
    figures = folder.figures(run) or {}
    error = figures.get('ate_rmse_m')
    return (f'ATE {"unknown" if error is None else f"{error:.4f} m"}, tracked '
            f'{figures.get("frames_tracked")} of {figures.get("frames_offered")}')


if __name__ == '__main__':
    sys.exit(main())
