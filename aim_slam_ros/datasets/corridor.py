"""A corridor around a block, walked once around and a little further.

The camera starts just after a corner and looks ahead, so that it sees its start again only when
it has turned the last corner.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.ndimage import gaussian_filter1d

from aim_slam_ros.datasets.motion import hand_held, heading, looking, rounded_loop
from aim_slam_ros.datasets.scene import Scene, SceneBuilder
from aim_slam_ros.datasets.textures import (
    Material, books, bricks, door, fabric, lamp, picture, plaster, tiles, with_notes, wood)

# Half the sides of the centre line, and half the corridor's width.
_CENTRE = (4.0, 2.75)
_HALF_WIDTH = 0.95
_HEIGHT = 2.6
_TEXEL_M = 0.0025
_RATE_HZ = 15.0
_WALK_M_S, _TURN_M_S = 1.1, 0.5
_CORNER_RADIUS = 0.85
_START_M, _OVERLAP_M = 0.3, 2.2
_STEP_M = 0.01


@dataclass(frozen=True)
class _Wall:
    """axis, at, facing as of a Quad; span: where along the wall there may be furniture."""

    axis: int
    at: float
    facing: int
    span: tuple[float, float]
    outer: bool


def corridor(rng: np.random.Generator) -> Scene:
    """Walls, furniture and the path, the same for the same random numbers."""
    builder = SceneBuilder(rng, _TEXEL_M)
    grounds = _grounds()
    for i, wall in enumerate(_corridor_walls()):
        half = (_CENTRE[1 - wall.axis] + (_HALF_WIDTH if wall.outer else -_HALF_WIDTH))
        builder.quad(wall.axis, wall.at, wall.facing, (-half, 0.0), (half, _HEIGHT),
                     partial(with_notes, ground=grounds[i], per_m2=1.2))
        _furnish(builder, wall)
    _floor_and_ceiling(builder)
    return _scene(builder, rng)


def _corridor_walls() -> tuple[_Wall, ...]:
    """The outer wall and the inner block, on each of the four sides."""
    walls = []
    for axis in (0, 1):
        for side in (-1, 1):
            outer, inner = _CENTRE[axis] + _HALF_WIDTH, _CENTRE[axis] - _HALF_WIDTH
            reach = _CENTRE[1 - axis]
            for at, facing, span, is_outer in (
                    (outer, -side, reach + _HALF_WIDTH - 0.25, True),
                    (inner, side, reach - _HALF_WIDTH - 0.2, False)):
                walls.append(_Wall(axis, side * at, facing, (-span, span), is_outer))
    return tuple(walls)


def _grounds() -> tuple[Material, ...]:
    """One look for each wall."""
    return (partial(bricks, colour=(148.0, 88.0, 70.0)),
            partial(plaster, colour=(196.0, 176.0, 128.0), contrast=0.22),
            partial(wood, colour=(160.0, 120.0, 86.0), plank=0.16),
            partial(plaster, colour=(120.0, 146.0, 158.0), contrast=0.22),
            partial(tiles, colours=((190.0, 190.0, 180.0), (130.0, 160.0, 150.0)), size=0.2),
            partial(plaster, colour=(178.0, 126.0, 116.0), contrast=0.22),
            partial(plaster, colour=(150.0, 164.0, 120.0), contrast=0.22),
            partial(bricks, colour=(140.0, 138.0, 132.0), size=(0.4, 0.2)))


def _furnish(builder: SceneBuilder, wall: _Wall) -> None:
    """Doors, pictures, cupboards and boards in random order along a wall."""
    rng = builder.rng
    at = wall.span[0] + rng.uniform(0.0, 0.3)
    pieces = (_door, _poster, _cupboard, _poster, _board, _bench)
    first = int(rng.integers(len(pieces)))
    for i in range(100):
        piece = pieces[(first + i) % len(pieces)]
        width = float(rng.uniform(0.6, 1.1))
        if at + width > wall.span[1]:
            return
        piece(builder, wall, (at, at + width))
        at += width + float(rng.uniform(0.12, 0.5))


def _door(builder: SceneBuilder, wall: _Wall, span: tuple[float, float]) -> None:
    frame = partial(wood, colour=_colour(builder.rng), plank=0.1)
    start = span[0], span[0] + 0.9
    builder.against(wall.axis, wall.at, wall.facing, start, (0.0, 2.05), 0.05, frame, door)


def _poster(builder: SceneBuilder, wall: _Wall, span: tuple[float, float]) -> None:
    low = float(builder.rng.uniform(0.9, 1.3))
    high = low + float(builder.rng.uniform(0.5, 1.0))
    builder.against(wall.axis, wall.at, wall.facing, span, (low, high), 0.025,
                    partial(wood, colour=(70.0, 60.0, 55.0)), picture)


def _cupboard(builder: SceneBuilder, wall: _Wall, span: tuple[float, float]) -> None:
    height, depth = builder.rng.uniform((0.8, 0.22), (1.9, 0.36))
    side = partial(wood, colour=_colour(builder.rng), plank=0.3)
    builder.against(wall.axis, wall.at, wall.facing, span, (0.0, float(height)), float(depth),
                    side, books)


def _board(builder: SceneBuilder, wall: _Wall, span: tuple[float, float]) -> None:
    cork = partial(with_notes, ground=partial(plaster, colour=(176.0, 138.0, 96.0)), per_m2=14.0)
    builder.against(wall.axis, wall.at, wall.facing, span, (1.0, 1.9), 0.04,
                    partial(wood, colour=(90.0, 70.0, 50.0)), cork)


def _bench(builder: SceneBuilder, wall: _Wall, span: tuple[float, float]) -> None:
    cloth = partial(fabric, colour=_colour(builder.rng))
    builder.against(wall.axis, wall.at, wall.facing, span, (0.25, 0.45), 0.34, cloth)
    builder.against(wall.axis, wall.at, wall.facing, (span[0], span[0] + 0.08), (0.0, 0.25),
                    0.3, cloth)
    builder.against(wall.axis, wall.at, wall.facing, span, (1.2, 1.7), 0.03, cloth, picture)


def _floor_and_ceiling(builder: SceneBuilder) -> None:
    """Four strips each, with lamps under the ceiling and mats on the floor."""
    colours = ((140.0, 120.0, 105.0), (90.0, 104.0, 112.0), (170.0, 158.0, 136.0))
    floor = partial(with_notes, ground=partial(tiles, colours=colours, size=0.33), per_m2=0.5)
    ceiling = partial(bricks, colour=(188.0, 188.0, 182.0), size=(0.6, 0.6), spread=0.08)
    for axis in (0, 1):
        for side in (-1, 1):
            low, high = _strip(axis, side)
            builder.quad(2, 0.0, 1, low, high, floor)
            builder.quad(2, _HEIGHT, -1, low, high, ceiling)
            _lamps_and_mats(builder, axis, side)


def _strip(axis: int, side: int) -> tuple[tuple[float, float], tuple[float, float]]:
    """The part of the floor along the walls of this axis and side; x strips take the corners."""
    low, high = [0.0, 0.0], [0.0, 0.0]
    centre = side * _CENTRE[axis]
    low[axis], high[axis] = centre - _HALF_WIDTH, centre + _HALF_WIDTH
    reach = _CENTRE[1 - axis] + (_HALF_WIDTH if axis == 0 else -_HALF_WIDTH)
    low[1 - axis], high[1 - axis] = -reach, reach
    return (low[0], low[1]), (high[0], high[1])


def _lamps_and_mats(builder: SceneBuilder, axis: int, side: int) -> None:
    rng = builder.rng
    reach = _CENTRE[1 - axis]
    for middle in np.arange(-reach + 0.5, reach, 1.9) + rng.uniform(0.0, 0.5):
        centre = np.zeros(2)
        centre[axis], centre[1 - axis] = side * _CENTRE[axis] + rng.uniform(-0.2, 0.2), middle
        half = rng.uniform(0.12, 0.5, 2)
        (x0, y0), (x1, y1) = centre - half, centre + half
        z = _HEIGHT - float(rng.uniform(0.05, 0.3))
        builder.box((x0, y0, z), (x1, y1, _HEIGHT), lamp)
        if rng.random() < 0.6:
            mat = partial(fabric, colour=_colour(rng))
            builder.box((x0, y0, 0.0), (x1, y1, 0.015), mat, {(2, 1): picture})


def _colour(rng: np.random.Generator) -> tuple[float, float, float]:
    red, green, blue = rng.uniform(60.0, 200.0, 3)
    return float(red), float(green), float(blue)


def _scene(builder: SceneBuilder, rng: np.random.Generator) -> Scene:
    line = rounded_loop(_CENTRE, _CORNER_RADIUS, _STEP_M)
    # The gaze turns a little before and after the feet do.
    angle = heading(line, 0.25 / _STEP_M)
    at_m = _walked(angle)
    time_s = np.arange(len(at_m)) / _RATE_HZ
    length = len(line) * _STEP_M
    lines = np.concatenate([line, line])
    angles = np.concatenate([angle, angle + 2.0 * np.pi])
    place = np.arange(len(lines)) * (length / len(line))
    x, y, yaw = (np.interp(at_m, place, values) for values in (lines[:, 0], lines[:, 1], angles))
    pitch = np.full(len(yaw), -0.06)
    forward = np.stack([np.cos(yaw), np.sin(yaw), pitch], 1)
    T_world_cam = looking(np.stack([x, y, np.full(len(x), 1.5)], 1), forward)
    return Scene(tuple(builder.quads), np.round(time_s * 1e9).astype(np.int64),
                 hand_held(rng, time_s, T_world_cam, 0.015, 0.003, 0.005))


def _walked(angle: np.ndarray) -> np.ndarray:
    """[N] metres along the line at each frame: slower where it turns."""
    turning = np.clip(np.gradient(angle) / _STEP_M * _CORNER_RADIUS, 0.0, 1.0)
    slow = gaussian_filter1d(turning, 0.3 / _STEP_M, mode='wrap')
    speed = np.tile(_WALK_M_S + (_TURN_M_S - _WALK_M_S) * np.clip(slow, 0.0, 1.0), 2)
    time_s = np.concatenate([[0.0], np.cumsum(_STEP_M / speed)])
    at_m = np.arange(len(time_s)) * _STEP_M
    start, stop = (np.interp(at, at_m, time_s)
                   for at in (_START_M, _START_M + len(angle) * _STEP_M + _OVERLAP_M))
    return np.interp(np.arange(start, stop, 1.0 / _RATE_HZ), time_s, at_m)
