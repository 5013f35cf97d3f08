"""What a recording knows of its images; the simulated model asks for it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from torch import Tensor


@dataclass(frozen=True)
class TrueView:
    """What a recording knows of one image.

    depth: [h,w] float32 along the optical axis in metres, 0 where unknown; some is known.
    K: [3,3] float64, pixels of the depth. T_world_cam: [4,4] float64, rigid, metres.
    """

    depth: np.ndarray
    K: Tensor
    T_world_cam: Tensor


class TruthProvider(Protocol):
    """Whoever knows the truth of a recording."""

    def at(self, stamp_ns: int) -> TrueView | None:
        """The image with this stamp; None where depth, pose or camera are not known."""
