"""What is compared: named settings, typed as one word or listed in a file."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Mapping

import yaml

METHODS = ('slam', 'chain', 'pose_mean')
_METHOD = 'method'


class VariantError(ValueError):
    """A description of variants that cannot be read: says what is wrong and what would do."""


@dataclass(frozen=True)
class Variant:
    """settings: by their full name, as text. method: one of METHODS."""

    name: str
    settings: Mapping[str, str] = field(default_factory=dict)
    method: str = 'slam'


@dataclass(frozen=True)
class Comparison:
    """Variants that share a table."""

    title: str
    variants: tuple[Variant, ...]


@dataclass(frozen=True)
class Preset:
    """settings: what all variants have in common."""

    settings: Mapping[str, str]
    comparisons: tuple[Comparison, ...]


def parsed_variant(text: str) -> Variant:
    """``name:section.key=value,method=chain``; a name alone has no settings of its own."""
    name, _, rest = text.partition(':')
    settings = {}
    for part in filter(None, rest.split(',')):
        key, equals, value = (word.strip() for word in part.partition('='))
        if not (key and equals):
            raise VariantError(f'{part!r} in {text!r} is not of the form section.key=value')
        settings[key] = value
    return _variant(name.strip(), settings, text)


def read_preset(path: Path) -> Preset:
    """A YAML file: ``settings`` (name: value) and ``tables`` (title: variant: name: value)."""
    try:
        content = yaml.safe_load(path.read_text(encoding='utf-8'))
    except OSError as error:
        raise VariantError(f'{path}: cannot be read ({error.strerror})') from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise VariantError(f'{path}: is not YAML ({error})') from error
    content = _mapping(content, str(path))
    unknown = set(content) - {'settings', 'tables'}
    if unknown or not content.get('tables'):
        raise VariantError(f'{path}: expected "tables", and "settings" if wanted, '
                           f'not {", ".join(sorted(content)) or "nothing"}')
    tables = _mapping(content['tables'], f'{path}: tables')
    return Preset(_settings(content.get('settings'), f'{path}: settings'),
                  tuple(_comparison(title, variants, f'{path}: {title}')
                        for title, variants in tables.items()))


def _comparison(title: str, variants: Any, where: str) -> Comparison:
    named = _mapping(variants, where)
    if not named:
        raise VariantError(f'{where}: has no variants')
    return Comparison(title, tuple(
        _variant(name, _settings(settings, f'{where}: {name}'), f'{where}: {name}')
        for name, settings in named.items()))


def _variant(name: str, settings: dict[str, str], where: str) -> Variant:
    method = settings.pop(_METHOD, 'slam')
    if not name:
        raise VariantError(f'{where!r} has no name before its colon')
    if method not in METHODS:
        raise VariantError(f'{where}: {method!r} is no method; expected one of '
                           + ', '.join(METHODS))
    return Variant(name, settings, method)


def _settings(content: Any, where: str) -> dict[str, str]:
    """Values as a person would type them after ``--set``."""
    return {name: value if isinstance(value, str) else json.dumps(value)
            for name, value in _mapping(content, where).items()}


def _mapping(content: Any, where: str) -> dict[str, Any]:
    """Nothing is an empty one; its keys as text."""
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise VariantError(f'{where}: expected "name: value" lines, not {content!r}')
    return {str(key): value for key, value in content.items()}
