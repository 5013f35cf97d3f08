"""Diagnostics over real serialisation."""

from __future__ import annotations

import pytest
from wire import over_wire

from msg_adapters import diagnostics
from msg_adapters.diagnostics import diagnostics_msg, values_of
from msg_adapters.stamps import stamp_ns

STAMP = 1_305_031_102_175_304_001
NAME = '/robot/frontend: tracking'


@pytest.mark.parametrize('level', [diagnostics.OK, diagnostics.WARN, diagnostics.ERROR,
                                   diagnostics.STALE])
def test_round_trip(level: bytes) -> None:
    values: dict[str, str | float | int] = {
        'state': 'tracked', 'rate_hz': 29.97002997, 'dropped': 12_345_678,
        'kappa': 1.0, 'latency_s': 0.0123456789}
    msg = over_wire(diagnostics_msg(NAME, level, 'tracking well', values, STAMP))
    assert stamp_ns(msg.header.stamp) == STAMP
    assert [(s.name, s.level, s.message) for s in msg.status] == [(NAME, level, 'tracking well')]
    assert values_of(msg, NAME) == {'state': 'tracked', 'rate_hz': '29.97', 'dropped': '12345678',
                                    'kappa': '1', 'latency_s': '0.0123457'}


def test_other_nodes_publish_there_too() -> None:
    msg = diagnostics_msg('/camera: driver', diagnostics.OK, '', {'temperature': 40}, STAMP)
    assert values_of(over_wire(msg), NAME) == {}
