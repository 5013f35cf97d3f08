"""What a setting is: a dataclass field with its meaning and its allowed values."""

from __future__ import annotations

import dataclasses
import re
from dataclasses import field
from typing import Any, TypeVar

import yaml

T = TypeVar('T')


class ConfigError(ValueError):
    """A setting that does not exist or a value outside its range."""


def setting(default: T, doc: str, low: float | None = None, high: float | None = None,
            choices: tuple[str, ...] | None = None, multiple_of: int = 1) -> T:
    """A dataclass field with its documentation and its allowed values."""
    return field(default=default,
                 metadata={'doc': doc, 'low': low, 'high': high, 'choices': choices,
                           'multiple_of': multiple_of})


def allowed(spec: dataclasses.Field[Any]) -> str:
    """The allowed values of a field, for a person."""
    low, high = spec.metadata['low'], spec.metadata['high']
    if spec.metadata['choices']:
        return 'one of ' + ', '.join(spec.metadata['choices'])
    if isinstance(spec.default, bool):
        return 'true or false'
    kind = {int: 'a whole number', float: 'a number'}.get(type(spec.default), 'text')
    if spec.metadata['multiple_of'] > 1:
        kind = f'a multiple of {spec.metadata["multiple_of"]}'
    if low is not None and high is not None:
        return f'{kind} from {low} to {high}'
    if low is not None:
        return f'{kind} of at least {low}'
    return kind


def checked(name: str, spec: dataclasses.Field[Any], value: Any) -> Any:
    """The value in the field's own type, or ConfigError."""
    refusal = ConfigError(f'{name}: {value!r} is not allowed; expected {allowed(spec)}')
    kind = type(spec.default)
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if type(value) is not kind:
        raise refusal
    low, high = spec.metadata['low'], spec.metadata['high']
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        # written so that nan, which compares false with everything, is refused too
        if not ((low is None or value >= low) and (high is None or value <= high)
                and abs(value) < float('inf')):
            raise refusal
    if spec.metadata['choices'] and value not in spec.metadata['choices']:
        raise refusal
    if kind is int and value % spec.metadata['multiple_of']:
        raise refusal
    return value


def parsed(name: str, text: str) -> Any:
    """The value that a person typed, or ConfigError."""
    try:
        value = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ConfigError(f'{name}: {text!r} cannot be read as a value') from error
    try:    # YAML takes 1e-3 for text: it wants 1.0e-3
        return float(value) if isinstance(value, str) else value
    except ValueError:
        return value


class Section:
    """Validates every field when it is made."""

    def __post_init__(self) -> None:
        for spec in dataclasses.fields(self):  # type: ignore[arg-type]
            words = re.findall('[A-Z][a-z]*', type(self).__name__.removesuffix('Config'))
            name = f'{"_".join(words).lower()}.{spec.name}'
            object.__setattr__(self, spec.name, checked(name, spec, getattr(self, spec.name)))
