"""Settings as ROS parameters: declared with their meaning and range, read once, then fixed."""

from __future__ import annotations

import dataclasses
import difflib
import sys
from typing import Any, TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node

from ..config import Config
from ..settings import Section, allowed, checked

S = TypeVar('S', bound=Section)
_MAX_INT = 2 ** 63 - 1


def declare_config(node: Node) -> Config:
    """Every setting as a read-only parameter ``section.name``; the Config that they make.

    Raises ConfigError, which names the parameter, for a value of a wrong type or range.
    """
    config = Config()
    values: dict[str, dict[str, Any]] = {}
    for name, spec in config.settings().items():
        section, _, field_name = name.rpartition('.')
        values.setdefault(section, {})[field_name] = declare(node, name, spec)
    sections = {name: dataclasses.replace(getattr(config, name), **fields)
                for name, fields in values.items() if name}
    return dataclasses.replace(config, **sections, **values.get('', {}))


def declare_section(node: Node, section: type[S]) -> S:
    """Every field of a node's own section as a read-only parameter; raises ConfigError."""
    specs = dataclasses.fields(section)  # type: ignore[arg-type]
    return section(**{spec.name: declare(node, spec.name, spec) for spec in specs})


def declare(node: Node, name: str, spec: dataclasses.Field[Any]) -> Any:
    """One setting as a read-only parameter; its value, in its own type. Raises ConfigError."""
    try:
        value = node.declare_parameter(name, spec.default, _descriptor(spec)).value
    except (InvalidParameterTypeException, InvalidParameterValueException):
        # Whole numbers are welcome where a number is expected; of the rest `checked` tells more.
        value = checked(name, spec, _as_given(node, name))
        node.declare_parameter(name, value, _descriptor(spec), ignore_override=True)
    return checked(name, spec, value)


def warn_of_unknown(node: Node, *others: type[Section]) -> None:
    """Say which given parameters mean nothing; call it when all have been declared.

    ROS drops them silently. others: what another node of this package takes, as one file or
    command line often serves several nodes.
    """
    known = {*Config().settings(), *(spec.name for section in others
                                     for spec in dataclasses.fields(section))}  # type: ignore
    given: dict[str, Any] = getattr(node, '_parameter_overrides', {})   # there is no public way
    for name in given:
        if node.has_parameter(name) or name in known or name.startswith('qos_overrides.'):
            continue
        own = list(node.get_parameters_by_prefix(''))
        near = difflib.get_close_matches(name, own, n=2, cutoff=0.6)
        hint = f'; did you mean {" or ".join(near)}?' if near else ''
        node.get_logger().warning(f'parameter {name} does not exist and is ignored{hint}')


def _as_given(node: Node, name: str) -> Any:
    """The value that came from outside, of whatever type."""
    value = node.declare_parameter(name, None, ParameterDescriptor(dynamic_typing=True)).value
    node.undeclare_parameter(name)
    return value


def _descriptor(spec: dataclasses.Field[Any]) -> ParameterDescriptor:
    low, high = spec.metadata['low'], spec.metadata['high']
    descriptor = ParameterDescriptor(description=spec.metadata['doc'], read_only=True,
                                     additional_constraints=allowed(spec))
    if low is None and high is None:
        return descriptor
    if isinstance(spec.default, float):
        descriptor.floating_point_range = [FloatingPointRange(
            from_value=float(-sys.float_info.max if low is None else low),
            to_value=float(sys.float_info.max if high is None else high))]
    else:
        descriptor.integer_range = [IntegerRange(
            from_value=-_MAX_INT if low is None else int(low),
            to_value=_MAX_INT if high is None else int(high),
            step=spec.metadata['multiple_of'])]
    return descriptor
