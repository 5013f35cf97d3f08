"""The state of a node, as diagnostic tools read it."""

from __future__ import annotations

from typing import Any, Mapping

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from .stamps import header

OK: bytes = DiagnosticStatus.OK
WARN: bytes = DiagnosticStatus.WARN
ERROR: bytes = DiagnosticStatus.ERROR
STALE: bytes = DiagnosticStatus.STALE


def diagnostics_msg(name: str, level: bytes, message: str,
                    values: Mapping[str, str | float | int], stamp_ns: int) -> DiagnosticArray:
    """One status. name: '<full name of the node>: <what it does>'; level: OK, WARN, ERROR, STALE.

    message: one line for a person.
    """
    pairs = [KeyValue(key=key, value=_text(value)) for key, value in values.items()]
    status = DiagnosticStatus(name=name, hardware_id='', level=level, message=message,
                              values=pairs)
    return DiagnosticArray(header=header(stamp_ns, ''), status=[status])


def _text(value: str | float | int) -> str:
    return f'{value:.6g}' if isinstance(value, float) else str(value)


def values_of(msg: Any, name: str) -> dict[str, str]:
    """The values of the status with this name; empty where the message is about others."""
    return {pair.key: pair.value for status in msg.status if status.name == name
            for pair in status.values}
