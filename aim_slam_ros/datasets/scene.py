"""A scene of textured, axis-aligned rectangles, and the boxes it is built from. World z is up."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Mapping

import cv2
import numpy as np

from aim_slam_ros.datasets.textures import Material, Surface

Point = tuple[float, float, float]
# Along which world axes a rectangle's texture runs (right or left, then up), by its normal's.
SPANNED = ((1, 2), (0, 2), (0, 1))
# Light baked into the textures, by the axis and the sign of the normal: from above, and a little
# from one side, so that the faces of a box differ.
_LIGHT = {(0, 1): 0.92, (0, -1): 0.78, (1, 1): 0.86, (1, -1): 0.7, (2, 1): 1.0, (2, -1): 0.75}
# The faces whose first axis runs to the left for whoever looks at them.
_MIRRORED = {(0, -1), (1, 1), (2, -1)}
_SMALLEST_LEVEL = 4


@dataclass(frozen=True)
class Quad:
    """A rectangle at coordinate ``at`` of world axis ``axis``, seen from the ``facing`` side.

    low, high: its bounds along SPANNED[axis]. levels: [h,w,3] uint8 RGB, each half the size of
    the one before; row 0 is at the high end of the second axis.
    """

    axis: int
    at: float
    facing: int
    low: tuple[float, float]
    high: tuple[float, float]
    levels: tuple[np.ndarray, ...]

    @property
    def texel_m(self) -> float:
        return (self.high[0] - self.low[0]) / self.levels[0].shape[1]

    def corners(self) -> np.ndarray:
        """[4,3] float64, in turn around the rectangle."""
        a, b = SPANNED[self.axis]
        out = np.full((4, 3), self.at)
        out[:, a] = [self.low[0], self.high[0], self.high[0], self.low[0]]
        out[:, b] = [self.low[1], self.low[1], self.high[1], self.high[1]]
        return out


@dataclass(frozen=True)
class Scene:
    """What the camera sees and the way it takes.

    stamps_ns: [N] int64. T_world_cam: [N,4,4] float64, rigid.
    """

    quads: tuple[Quad, ...]
    stamps_ns: np.ndarray
    T_world_cam: np.ndarray


class SceneBuilder:
    """Collects rectangles and paints them."""

    def __init__(self, rng: np.random.Generator, texel_m: float) -> None:
        self.rng = rng
        self.texel_m = texel_m
        self.quads: list[Quad] = []

    def quad(self, axis: int, at: float, facing: int, low: tuple[float, float],
             high: tuple[float, float], material: Material) -> None:
        """Add one rectangle."""
        # A seed of its own: what one surface draws does not change the others.
        rng = np.random.default_rng(self.rng.integers(2**63))
        surface = Surface(rng, high[0] - low[0], high[1] - low[1], self.texel_m)
        image = material(surface) * _LIGHT[axis, facing]
        if (axis, facing) in _MIRRORED:
            image = image[:, ::-1]
        base = np.ascontiguousarray(np.clip(image, 0.0, 255.0).astype(np.uint8))
        self.quads.append(Quad(axis, at, facing, low, high, _pyramid(base)))

    def box(self, low: Point, high: Point, material: Material,
            other: Mapping[tuple[int, int], Material] | None = None) -> None:
        """Add a box's six faces; ``other`` names another material by (axis, facing)."""
        for axis, (a, b) in enumerate(SPANNED):
            for facing, at in ((-1, low[axis]), (1, high[axis])):
                chosen = (other or {}).get((axis, facing), material)
                self.quad(axis, at, facing, (low[a], low[b]), (high[a], high[b]), chosen)

    def against(self, axis: int, at: float, facing: int, span: tuple[float, float],
                z: tuple[float, float], depth: float, material: Material,
                front: Material | None = None) -> None:
        """Add a box with its back to a wall: ``span`` along the wall, ``depth`` into the room."""
        low, high = [0.0, 0.0, z[0]], [0.0, 0.0, z[1]]
        low[axis], high[axis] = sorted((at, at + facing * depth))
        low[1 - axis], high[1 - axis] = span
        self.box((low[0], low[1], low[2]), (high[0], high[1], high[2]), material,
                 {(axis, facing): front or material})


def _pyramid(base: np.ndarray) -> tuple[np.ndarray, ...]:
    levels = [base]
    while min(levels[-1].shape[:2]) >= 2 * _SMALLEST_LEVEL:
        h, w = levels[-1].shape[:2]
        levels.append(cv2.resize(levels[-1], (w // 2, h // 2), interpolation=cv2.INTER_AREA))
    return tuple(levels)
