"""Write config/*.yaml, the parameter files of the nodes, from the settings in the code."""

from __future__ import annotations

import argparse
import dataclasses
import sys
import textwrap
from pathlib import Path
from typing import Any, Iterator, Sequence

import yaml

from aim_slam_ros.config import Config
from aim_slam_ros.nodes.frontend.parameters import FrontendParameters
from aim_slam_ros.nodes.loop_closure.parameters import LoopClosureParameters
from aim_slam_ros.settings import Section, allowed

NODES: dict[str, type[Section]] = {'frontend': FrontendParameters,
                                   'loop_closure': LoopClosureParameters}
_WIDTH = 99
# Each line is a paragraph.
_HEAD = (
    'Every parameter of the node {node}, with its default, its meaning and its allowed values. '
    'Written by `make parameters` from the settings in the code. Copy this file and keep of it '
    'what you change:\n'
    '    ros2 run aim_slam_ros {node} --ros-args --params-file FILE\n'
    '/** stands for any namespace. Besides these there are use_sim_time and '
    'qos_overrides./TOPIC.*, as in every node. All are read once, when the node starts.')
_COMMON = 'Both nodes take what follows; where both use it, as the model, give both the same.'


def main(argv: Sequence[str] | None = None) -> int:
    """Write one file for each node; exit status 0."""
    parser = argparse.ArgumentParser(prog='parameters', description=__doc__, allow_abbrev=False)
    parser.add_argument('folder', metavar='DIR', type=Path, help='where the files go')
    folder = parser.parse_args(argv).folder
    folder.mkdir(parents=True, exist_ok=True)
    for node in NODES:
        (folder / f'{node}.yaml').write_text(parameter_file(node), encoding='utf-8')
    return 0


def parameter_file(node: str) -> str:
    """The parameter file of ``frontend`` or ``loop_closure``."""
    lines = [*_comment(_HEAD.format(node=node), 0), f'/**/{node}:', '  ros__parameters:']
    for spec in dataclasses.fields(NODES[node]):  # type: ignore[arg-type]
        lines += _entry(spec.name, spec, 4)
    lines += ['', *_comment(_COMMON, 4)]
    section = ''
    for name, spec in Config().settings().items():
        prefix, _, field_name = name.rpartition('.')
        if prefix != section:
            lines += ['', f'    {prefix}:']
            section = prefix
        lines += _entry(field_name, spec, 6 if prefix else 4)
    return '\n'.join(lines) + '\n'


def _entry(name: str, spec: dataclasses.Field[Any], indent: int) -> Iterator[str]:
    # safe_dump writes what a ROS parameter of this type needs: a float with its point, quotes
    # around words that YAML takes for something else
    value = yaml.safe_dump(spec.default).split('\n')[0]
    yield from _comment(spec.metadata['doc'], indent)
    if allowed(spec) not in ('text', 'true or false'):
        yield from _comment(allowed(spec), indent)
    yield f'{" " * indent}{name}: {value}'


def _comment(text: str, indent: int) -> Iterator[str]:
    for paragraph in text.split('\n'):
        margin = ' ' * (len(paragraph) - len(paragraph.lstrip()))
        yield from textwrap.wrap(
            paragraph, _WIDTH, initial_indent=f'{" " * indent}# ',
            subsequent_indent=f'{" " * indent}# {margin}', break_on_hyphens=False)


if __name__ == '__main__':
    sys.exit(main())
