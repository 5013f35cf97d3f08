"""A furnished room of 5 x 4 x 2.7 m, walked around once with a hand-held camera."""

from __future__ import annotations

from functools import partial

import numpy as np

from aim_slam_ros.datasets.motion import hand_held, looking
from aim_slam_ros.datasets.scene import Point, Scene, SceneBuilder
from aim_slam_ros.datasets.textures import (
    Colour, Material, books, bricks, door, fabric, lamp, picture, plaster, tiles, with_notes, wood)

_HALF_X, _HALF_Y, _HEIGHT = 2.5, 2.0, 2.7
_TEXEL_M = 0.002
_FRAMES, _RATE_HZ = 330, 30.0
# A little more than once around, so that the start is seen again.
_TURNS = 1.06


def room(rng: np.random.Generator) -> Scene:
    """Walls, furniture and the path, the same for the same random numbers."""
    builder = SceneBuilder(rng, _TEXEL_M)
    _walls(builder)
    _along_x(builder)
    _along_y(builder)
    _middle(builder)
    time_s = np.arange(_FRAMES) / _RATE_HZ
    return Scene(tuple(builder.quads), np.round(time_s * 1e9).astype(np.int64),
                 _path(rng, time_s))


def _walls(builder: SceneBuilder) -> None:
    brick = partial(with_notes, ground=partial(bricks, colour=(150.0, 92.0, 74.0)), per_m2=0.3)
    green = partial(with_notes, ground=partial(plaster, colour=(140.0, 160.0, 132.0)))
    ochre = partial(with_notes, ground=partial(plaster, colour=(196.0, 168.0, 112.0)))
    panel = partial(with_notes, ground=partial(wood, colour=(168.0, 128.0, 92.0), plank=0.2))
    x, y, z = (-_HALF_X, _HALF_X), (-_HALF_Y, _HALF_Y), (0.0, _HEIGHT)
    builder.quad(0, x[0], 1, (y[0], z[0]), (y[1], z[1]), brick)
    builder.quad(0, x[1], -1, (y[0], z[0]), (y[1], z[1]), green)
    builder.quad(1, y[0], 1, (x[0], z[0]), (x[1], z[1]), ochre)
    builder.quad(1, y[1], -1, (x[0], z[0]), (x[1], z[1]), panel)
    floor = partial(wood, colour=(150.0, 112.0, 80.0))
    builder.quad(2, z[0], 1, (x[0], y[0]), (x[1], y[1]), floor)
    builder.quad(2, z[1], -1, (x[0], y[0]), (x[1], y[1]),
                 partial(plaster, colour=(205.0, 205.0, 198.0)))


def _along_x(builder: SceneBuilder) -> None:
    """The furniture of the two long walls: shelves and desk; sofa, pictures and a door."""
    oak: Material = partial(wood, colour=(176.0, 134.0, 84.0), plank=0.25)
    dark: Material = partial(wood, colour=(96.0, 72.0, 58.0), plank=0.3)
    cloth: Material = partial(fabric, colour=(118.0, 92.0, 150.0))
    back, front = (1, -_HALF_Y, 1), (1, _HALF_Y, -1)
    builder.against(*back, (-2.3, -1.1), (0.0, 2.05), 0.32, dark, books)
    builder.against(*back, (-0.7, 0.9), (0.7, 0.75), 0.55, oak)
    builder.against(*back, (-0.65, -0.2), (0.0, 0.7), 0.5, oak, partial(books, row_m=0.23))
    builder.against(*back, (0.8, 0.88), (0.0, 0.7), 0.5, dark)
    builder.against(*back, (0.0, 0.55), (0.8, 1.15), 0.1, dark, picture)
    builder.against(*back, (-0.6, -0.35), (0.75, 1.0), 0.3, cloth)
    builder.against(*back, (-0.5, 0.3), (1.35, 1.95), 0.03, dark, picture)
    builder.against(*back, (1.3, 2.15), (0.0, 2.05), 0.04, oak, door)
    builder.against(*front, (-1.9, 0.1), (0.0, 0.42), 0.6, cloth)
    builder.against(*front, (-1.9, 0.1), (0.42, 0.85), 0.2, cloth)
    builder.against(*front, (-1.9, -1.7), (0.42, 0.62), 0.6, cloth)
    for left, width, low, high in ((-1.9, 0.7, 1.2, 2.0), (-1.0, 0.5, 1.1, 1.6),
                                   (-0.3, 0.9, 1.3, 1.9), (1.0, 0.6, 1.2, 2.1)):
        builder.against(*front, (left, left + width), (low, high), 0.03, dark, picture)
    builder.against(*front, (0.6, 1.9), (0.0, 0.8), 0.42, oak, partial(books, row_m=0.38))
    builder.against(*front, (0.75, 1.0), (0.8, 1.1), 0.25, partial(tiles, size=0.05, colours=(
        (200.0, 90.0, 60.0), (60.0, 90.0, 170.0), (220.0, 210.0, 180.0))))


def _along_y(builder: SceneBuilder) -> None:
    """The furniture of the two short walls: cupboards, boxes and pictures."""
    oak: Material = partial(wood, colour=(176.0, 134.0, 84.0), plank=0.25)
    white: Material = partial(with_notes, ground=partial(plaster, colour=(205.0, 200.0, 190.0)),
                              per_m2=4.0)
    left, right = (0, -_HALF_X, 1), (0, _HALF_X, -1)
    builder.against(*left, (-1.2, -0.3), (0.0, 1.2), 0.45, oak, white)
    builder.against(*left, (0.0, 1.1), (0.0, 0.5), 0.5,
                    partial(fabric, colour=(90.0, 130.0, 110.0)))
    builder.against(*left, (-0.1, 0.6), (1.1, 1.9), 0.04, oak, picture)
    builder.against(*left, (0.8, 1.4), (1.3, 2.2), 0.04, oak, picture)
    builder.against(*left, (-1.1, -0.6), (1.2, 1.55), 0.3, partial(bricks, colour=(
        120.0, 120.0, 140.0), size=(0.07, 0.035)))
    builder.against(*right, (-0.5, 0.7), (0.0, 1.9), 0.4, oak, partial(books, row_m=0.31))
    builder.against(*right, (1.0, 1.6), (0.0, 0.9), 0.5, white)
    builder.against(*right, (1.05, 1.4), (0.9, 1.3), 0.35, partial(fabric, colour=(
        190.0, 120.0, 70.0)))
    builder.against(*right, (-1.7, -0.8), (1.0, 1.8), 0.04, oak, picture)


def _middle(builder: SceneBuilder) -> None:
    """A carpet, a table with things on it, a stool and a hanging lamp."""
    legs: Material = partial(wood, colour=(120.0, 84.0, 60.0), plank=0.1)
    builder.box((-1.2, -0.85, 0.0), (1.1, 0.9, 0.012), legs, {(2, 1): picture})
    builder.box((-0.5, -0.3, 0.4), (0.5, 0.3, 0.45), legs)
    for x in (-0.48, 0.42):
        for y in (-0.28, 0.22):
            builder.box((x, y, 0.012), (x + 0.06, y + 0.06, 0.4), legs)
    things: tuple[tuple[Point, Point, Colour], ...] = (
        ((-0.42, -0.2, 0.45), (-0.2, 0.1, 0.52), (180.0, 70.0, 60.0)),
        ((-0.38, -0.15, 0.52), (-0.22, 0.05, 0.58), (60.0, 100.0, 160.0)),
        ((0.05, 0.0, 0.45), (0.17, 0.12, 0.75), (80.0, 140.0, 90.0)),
        ((0.25, -0.22, 0.45), (0.44, -0.05, 0.6), (200.0, 180.0, 90.0)))
    for low, high, colour in things:
        builder.box(low, high, partial(with_notes, ground=partial(fabric, colour=colour),
                                       per_m2=30.0))
    builder.box((-0.2, -0.2, 2.25), (0.2, 0.2, 2.4), lamp)
    builder.box((-0.02, -0.02, 2.4), (0.02, 0.02, _HEIGHT), legs)


def _path(rng: np.random.Generator, time_s: np.ndarray) -> np.ndarray:
    """[N,4,4]: around the table, looking across it, the gaze wandering a little."""
    angle = 0.4 + 2.0 * np.pi * _TURNS * time_s / time_s[-1]
    position = np.stack([1.35 * np.cos(angle), 0.95 * np.sin(angle),
                         1.45 + 0.12 * np.sin(2.0 * angle + 1.0)], 1)
    # Beyond the table: the camera turns less than it travels, and what is near moves.
    target = np.stack([-0.55 * np.cos(angle + 0.35), -0.4 * np.sin(angle + 0.35),
                       0.95 + 0.15 * np.sin(3.0 * angle)], 1)
    return hand_held(rng, time_s, looking(position, target - position), 0.012, 0.003, 0.006)
