"""How large the simulated errors are. The numbers are fixed: results are compared across them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace


@dataclass(frozen=True)
class ErrorLevels:
    """Standard deviations, or root mean squares where there are several directions.

    log_scale: of an inference's unit. focal: relative; a frame has the same in all its inferences.
    warp: of the smooth relative error of a depth image, of each inference and frame. pixel: of
    the relative depth error of every pixel by itself.
    smear_px: pixels between the two sides of an edge. rotation_rad, translation: of a view's pose
    in the first view, the latter relative to the view's median depth. lasting_warp: a frame has
    the same warp in all its inferences.
    """

    log_scale: float = 0.3
    focal: float = 0.02
    warp: float = 0.02
    pixel: float = 0.0075
    smear_px: float = 2.0
    rotation_rad: float = math.radians(0.4)
    translation: float = 0.0175
    lasting_warp: bool = False

    def times(self, factor: float) -> ErrorLevels:
        """Every level multiplied."""
        return ErrorLevels(
            factor * self.log_scale, factor * self.focal, factor * self.warp, factor * self.pixel,
            factor * self.smear_px, factor * self.rotation_rad, factor * self.translation,
            self.lasting_warp)


PRESETS = {
    'vggt': ErrorLevels(),
    'mild': ErrorLevels().times(0.5),
    'harsh': ErrorLevels().times(2.0),
    'none': ErrorLevels().times(0.0),
    'correlated': replace(ErrorLevels(), lasting_warp=True),
}
