"""One figure of a run, and what a file may hold of it."""

from __future__ import annotations

import math
from typing import Mapping

Metric = float | int | str | bool | None


def finite(metrics: Mapping[str, Metric]) -> dict[str, Metric]:
    """The same, None for a figure that is not finite, since JSON knows no NaN."""
    return {name: None if isinstance(value, float) and not math.isfinite(value) else value
            for name, value in metrics.items()}
