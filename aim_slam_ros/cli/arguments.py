"""Checks of what a user typed, made before anything slow is imported or started."""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Callable, Iterable

from aim_slam_ros.config import Config
from aim_slam_ros.settings import ConfigError, allowed


class Refusal(Exception):
    """The command line asks for something that cannot be done; says what would be allowed."""


def whole_number(low: int) -> Callable[[str], int]:
    """An argparse type: a whole number of at least ``low``."""
    def parse(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = low - 1
        if value < low:
            raise argparse.ArgumentTypeError(
                f'{text!r} is not allowed; expected a whole number of at least {low}')
        return value
    return parse


def assignment(text: str) -> tuple[str, str]:
    """An argparse type: ``section.name=value``."""
    name, equals, value = text.partition('=')
    if not (name and equals):
        raise argparse.ArgumentTypeError(f'{text!r} is not of the form section.name=value')
    return name.strip(), value


def configured(assignments: Iterable[tuple[str, str]]) -> Config:
    """The configuration with these settings; a later one wins. Raises Refusal."""
    try:
        return Config().with_values(dict(assignments))
    except ConfigError as error:
        raise Refusal(f'{error}\n(--list-settings shows every setting)') from error


def writable_folder(path: Path) -> Path:
    """The folder, made where needed and tried with a file; raises Refusal."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise Refusal(f'--out {path}: the folder cannot be written ({error.strerror}); '
                      'name another one') from error
    return path


def selection(length: int, start: int, count: int | None, stride: int) -> range:
    """Indices of the images asked for; raises Refusal where there are none."""
    if start >= length:
        raise Refusal(f'--start {start} is beyond the end: the dataset has {length} images, '
                      f'0 to {length - 1}')
    return range(start, length if count is None else min(length, start + count), stride)


def settings_text() -> str:
    """Every setting with its default, its range and its meaning."""
    return '\n'.join(f'{name} = {spec.default}\n    {spec.metadata["doc"]} ({allowed(spec)})'
                     for name, spec in Config().settings().items())
