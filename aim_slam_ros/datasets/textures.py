"""Procedural surfaces for the rendered scenes.

A material paints a Surface: [h,w,3] float32 RGB in 0..255, row 0 at the top. Every surface has
noise from half a metre down to two texels, so that it shows detail at any distance, and draws its
own random numbers, so that no two places look alike.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Callable

import cv2
import numpy as np

Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Surface:
    """What is to be painted: its size in metres, its texel size and its random numbers."""

    rng: np.random.Generator
    width_m: float
    height_m: float
    texel_m: float

    @property
    def shape(self) -> tuple[int, int]:
        """(h, w) in texels."""
        return (max(2, round(self.height_m / self.texel_m)),
                max(2, round(self.width_m / self.texel_m)))

    def x_m(self) -> np.ndarray:
        """[w] float32: metres from the left."""
        return (np.arange(self.shape[1], dtype=np.float32) + 0.5) * self.texel_m

    def y_m(self) -> np.ndarray:
        """[h] float32: metres from the top."""
        return (np.arange(self.shape[0], dtype=np.float32) + 0.5) * self.texel_m


Material = Callable[[Surface], np.ndarray]


def noise(surface: Surface, coarsest_m: float = 0.4, stretch: float = 1.0,
          finest_m: float = 0.0, roughness: float = 0.9) -> np.ndarray:
    """[h,w] float32, zero mean, about unit deviation: random fields of halving wavelength.

    stretch: how much longer than high its features are. roughness: each octave's amplitude over
    that of the one before.
    """
    h, w = surface.shape
    out, weight, power = np.zeros((2, 2), np.float32), 1.0, 0.0
    wavelength = coarsest_m
    while wavelength >= max(2.0 * surface.texel_m, finest_m):
        cells = (math.ceil(surface.height_m / wavelength) + 2,
                 math.ceil(surface.width_m / (wavelength * stretch)) + 2)
        # What is coarse so far stays small until a finer octave is added to it.
        out = cv2.resize(out, cells[::-1], interpolation=cv2.INTER_CUBIC)
        out += weight * surface.rng.standard_normal(cells, dtype=np.float32)
        power += weight**2
        wavelength, weight = wavelength / 2.0, weight * roughness
    out = cv2.resize(out, (w, h), interpolation=cv2.INTER_CUBIC)
    return out / np.float32(0.7 * math.sqrt(max(power, 1e-9)))


def plaster(surface: Surface, colour: Colour, contrast: float = 0.2) -> np.ndarray:
    """A stained wall."""
    return _tinted(surface, colour, 1.0 + contrast * noise(surface))


def bricks(surface: Surface, colour: Colour, size: tuple[float, float] = (0.24, 0.08),
           spread: float = 0.22) -> np.ndarray:
    """Rows of bricks, each of its own tone, shifted at random."""
    rng, (width, height) = surface.rng, size
    row = (surface.y_m() / height).astype(np.int32)
    along = surface.x_m()[None, :] / width + rng.random(row[-1] + 1, dtype=np.float32)[row, None]
    column = along.astype(np.int32)
    tone = 1.0 + spread * rng.standard_normal((row[-1] + 1, int(column.max()) + 1),
                                              dtype=np.float32)[row[:, None], column]
    joint = 0.01
    mortar = (((along - column) * width < joint)
              | ((surface.y_m() % height) < joint)[:, None])
    tone = np.where(mortar, np.float32(1.5), tone)
    return _tinted(surface, colour, tone * (1.0 + 0.14 * noise(surface, 0.12)))


def tiles(surface: Surface, colours: tuple[Colour, ...], size: float = 0.3) -> np.ndarray:
    """Square tiles of randomly chosen colours."""
    row = (surface.y_m() / size).astype(np.int32)
    column = (surface.x_m() / size).astype(np.int32)
    chosen = surface.rng.integers(0, len(colours), (row[-1] + 1, column[-1] + 1))
    palette = np.array(colours, np.float32)[chosen]
    palette = palette * surface.rng.uniform(0.75, 1.2, (*chosen.shape, 1)).astype(np.float32)
    image = palette[row[:, None], column]
    image *= (1.0 + 0.15 * noise(surface, 0.3))[..., None]
    image[(surface.y_m() % size) < 0.008] *= 0.55
    image[:, (surface.x_m() % size) < 0.008] *= 0.55
    return image


def wood(surface: Surface, colour: Colour, plank: float = 0.12) -> np.ndarray:
    """Planks along the width, with grain."""
    row = (surface.y_m() / plank).astype(np.int32)
    tone = 1.0 + 0.16 * surface.rng.standard_normal(row[-1] + 1, dtype=np.float32)[row, None]
    tone = tone * (1.0 + 0.15 * noise(surface, 0.08, stretch=5.0) + 0.07 * noise(surface, 0.3))
    tone[(surface.y_m() % plank) < 0.005] *= 0.5
    return _tinted(surface, colour, tone)


def fabric(surface: Surface, colour: Colour) -> np.ndarray:
    """Stripes of random widths and tones."""
    edges = np.cumsum(surface.rng.uniform(0.02, 0.16, 4 + int(surface.width_m / 0.02)))
    stripe = np.searchsorted(edges, surface.x_m())
    tones = surface.rng.uniform(0.55, 1.35, (len(edges) + 1, 3)).astype(np.float32)
    image = np.array(colour, np.float32) * tones[stripe]
    return image[None] * (1.0 + 0.2 * noise(surface, 0.15))[..., None]


def books(surface: Surface, row_m: float = 0.34) -> np.ndarray:
    """A shelf's front: rows of spines of random widths, heights and colours."""
    h, w = surface.shape
    image = np.full((h, w, 3), 45.0, np.float32)
    for bottom in np.arange(row_m, surface.height_m + 1e-6, row_m):
        left = 0.02
        while left < surface.width_m - 0.05:
            width = surface.rng.uniform(0.018, 0.06)
            top = bottom - surface.rng.uniform(0.6, 0.9) * row_m
            _spine(image, surface, (left, top, width, bottom - 0.025 - top))
            left += width + surface.rng.choice([0.001, 0.001, 0.002, 0.08])
    return image * (1.0 + 0.1 * noise(surface, 0.1))[..., None]


def picture(surface: Surface) -> np.ndarray:
    """A poster: shapes and letters on a light or dark ground, with a border."""
    rng, (h, w) = surface.rng, surface.shape
    # OpenCV draws smooth edges into bytes only.
    image = np.empty((h, w, 3), np.uint8)
    image[:] = rng.integers(40, 240, 3)
    for _ in range(int(rng.integers(14, 26))):
        _random_shape(image, rng)
    for _ in range(4):
        text = ''.join(rng.choice(list('ABCDEFGHKLMNPRSTUVXYZ23456789'), 6))
        place = (int(rng.uniform(0, 0.6) * w), int(rng.uniform(0.1, 1.0) * h))
        cv2.putText(image, text, place, cv2.FONT_HERSHEY_SIMPLEX, rng.uniform(0.8, 2.4) * w / 300,
                    rng.uniform(0.0, 255.0, 3).tolist(), max(1, w // 90), cv2.LINE_AA)
    border = max(2, round(0.02 / surface.texel_m))
    cv2.rectangle(image, (0, 0), (w - 1, h - 1), rng.uniform(10.0, 90.0, 3).tolist(), border)
    return image * (1.0 + 0.1 * noise(surface, 0.2))[..., None]


def door(surface: Surface) -> np.ndarray:
    """A panelled door with a handle, a numbered sign and a notice."""
    rng = surface.rng
    image = wood(surface, tuple(rng.uniform(70.0, 200.0, 3)), 0.4)
    width, height = surface.width_m, surface.height_m
    for top in np.sort(rng.uniform(0.1, 0.75, 3)) * height:
        _outline(image, surface, (0.12, top, width - 0.24, 0.22 * height))
    _fill(image, surface, (0.08 * width, 0.5 * height, 0.05, 0.14), (210.0, 200.0, 170.0))
    sign = Surface(rng, 0.26, 0.16, surface.texel_m)
    notice = Surface(rng, 0.3, 0.42, surface.texel_m)
    _paste(image, surface, picture(sign), 0.5 * width - 0.13, 0.16 * height)
    _paste(image, surface, picture(notice), rng.uniform(0.1, width - 0.4), 0.33 * height)
    return image


def with_notes(surface: Surface, ground: Material, per_m2: float = 1.0) -> np.ndarray:
    """Another material with small pictures and stickers on it."""
    image, rng = ground(surface), surface.rng
    for _ in range(round(per_m2 * surface.width_m * surface.height_m)):
        note = Surface(rng, rng.uniform(0.08, 0.35), rng.uniform(0.08, 0.35), surface.texel_m)
        left = rng.uniform(0.0, max(0.01, surface.width_m - note.width_m))
        top = rng.uniform(0.0, max(0.01, surface.height_m - note.height_m))
        _paste(image, surface, picture(note), left, top)
    return image


def lamp(surface: Surface) -> np.ndarray:
    """A bright panel with a grid."""
    image = plaster(surface, (245.0, 240.0, 225.0), 0.04)
    image[(surface.y_m() % 0.1) < 0.01] *= 0.6
    image[:, (surface.x_m() % 0.13) < 0.01] *= 0.6
    return image


def _tinted(surface: Surface, colour: Colour, tone: np.ndarray) -> np.ndarray:
    """A colour in varying tones, its hue drifting over the surface."""
    image = tone[..., None] * np.array(colour, np.float32)
    for channel in range(3):
        image[..., channel] *= 1.0 + 0.06 * noise(surface, 1.0, finest_m=0.2)
    return image


def _random_shape(image: np.ndarray, rng: np.random.Generator) -> None:
    h, w = image.shape[:2]
    colour = rng.uniform(0.0, 255.0, 3).tolist()
    centre = (rng.random(2) * (w, h)).astype(int)
    radius = int(rng.uniform(0.03, 0.25) * min(w, h)) + 2
    kind = rng.integers(3)
    if kind == 0:
        cv2.circle(image, centre.tolist(), radius, colour, cv2.FILLED, cv2.LINE_AA)
    elif kind == 1:
        corner = centre + rng.integers(3, radius + 4, 2)
        cv2.rectangle(image, centre.tolist(), corner.tolist(), colour, cv2.FILLED)
    else:
        corners = centre + rng.integers(-2 * radius, 2 * radius, (int(rng.integers(3, 6)), 2))
        cv2.fillPoly(image, [corners.astype(np.int32)], colour, cv2.LINE_AA)


def _spine(image: np.ndarray, surface: Surface,
           rect_m: tuple[float, float, float, float]) -> None:
    left, top, width, height = rect_m
    rng = surface.rng
    _fill(image, surface, rect_m, tuple(rng.uniform(20.0, 230.0, 3)))
    for fraction in rng.uniform(0.05, 0.9, int(rng.integers(1, 4))):
        _fill(image, surface, (left, top + fraction * height, width, rng.uniform(0.005, 0.03)),
              tuple(rng.uniform(20.0, 250.0, 3)))


def _slices(surface: Surface, rect_m: tuple[float, float, float, float]) -> tuple[slice, slice]:
    left, top, width, height = (round(value / surface.texel_m) for value in rect_m)
    return (slice(max(0, top), max(0, top + max(1, height))),
            slice(max(0, left), max(0, left + max(1, width))))


def _fill(image: np.ndarray, surface: Surface, rect_m: tuple[float, float, float, float],
          colour: Colour) -> None:
    """Fill (left, top, width, height) in metres."""
    image[_slices(surface, rect_m)] = colour


def _outline(image: np.ndarray, surface: Surface,
             rect_m: tuple[float, float, float, float]) -> None:
    """Darken a rectangle's edge, and its inside a little."""
    left, top, width, height = rect_m
    image[_slices(surface, rect_m)] *= 0.6
    inner = (left + 0.015, top + 0.015, width - 0.03, height - 0.03)
    image[_slices(surface, inner)] *= 1.45


def _paste(image: np.ndarray, surface: Surface, patch: np.ndarray, left_m: float,
           top_m: float) -> None:
    """Put a patch on the image, cut where it reaches over the edge."""
    top, left = round(top_m / surface.texel_m), round(left_m / surface.texel_m)
    target = image[top:top + patch.shape[0], left:left + patch.shape[1]]
    target[:] = patch[:target.shape[0], :target.shape[1]]
