"""Exact depth and antialiased colour of a scene seen by a pinhole camera."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from aim_slam_ros.datasets.scene import SPANNED, Quad, Scene

_NEAR_M = 0.02
# Colour samples per pixel along each axis.
_SUPERSAMPLING = 2
# OpenCV's remap takes no image wider than 32767.
_ROW = 1024
_MAX_LEVELS = 16


@dataclass(frozen=True)
class View:
    """What the camera sees. image: [H,W,3] uint8 RGB. depth: [H,W] float32, metres, exact."""

    image: np.ndarray
    depth: np.ndarray


@dataclass(frozen=True)
class _Rays:
    """Rays of all pixels: point = origin + z * direction, so z is the depth.

    origin: [3] float64. direction, inverse: [3,H,W] float32, in world axes.
    """

    K: np.ndarray
    T_cam_world: np.ndarray
    origin: np.ndarray
    direction: np.ndarray
    inverse: np.ndarray

    @property
    def size(self) -> tuple[int, int]:
        """(H, W)."""
        return self.direction.shape[1], self.direction.shape[2]


@dataclass(frozen=True)
class _Hits:
    """z: [H,W] float32, metres, inf where nothing is hit. quad: [H,W] int16, index or -1."""

    z: np.ndarray
    quad: np.ndarray


def render_view(scene: Scene, T_world_cam: np.ndarray, K: np.ndarray,
                size: tuple[int, int]) -> View:
    """One view; K [3,3] in pixels, size (W, H). Pixel centres are at integers."""
    width, height = size
    depth = _cast(scene, _rays(T_world_cam, K, width, height)).z
    fine_K = K.copy()
    fine_K[:2] *= _SUPERSAMPLING
    fine_K[:2, 2] += (_SUPERSAMPLING - 1) / 2.0
    rays = _rays(T_world_cam, fine_K, width * _SUPERSAMPLING, height * _SUPERSAMPLING)
    colour = _shade(scene, rays, _cast(scene, rays))
    image = cv2.resize(colour, size, interpolation=cv2.INTER_AREA)
    return View(image, np.where(np.isfinite(depth), depth, np.float32(0.0)))


def _rays(T_world_cam: np.ndarray, K: np.ndarray, width: int, height: int) -> _Rays:
    u = ((np.arange(width) - K[0, 2]) / K[0, 0]).astype(np.float32)
    v = ((np.arange(height) - K[1, 2]) / K[1, 1]).astype(np.float32)
    R = T_world_cam[:3, :3].astype(np.float32)
    direction = np.stack([R[i, 0] * u[None] + (R[i, 1] * v[:, None] + R[i, 2])
                          for i in range(3)])
    with np.errstate(divide='ignore'):
        inverse = 1.0 / direction
    return _Rays(K, np.linalg.inv(T_world_cam), T_world_cam[:3, 3], direction, inverse)


def _cast(scene: Scene, rays: _Rays) -> _Hits:
    """The nearest rectangle along every ray."""
    hits = _Hits(np.full(rays.size, np.inf, np.float32), np.full(rays.size, -1, np.int16))
    with np.errstate(invalid='ignore', over='ignore'):
        for index, quad in enumerate(scene.quads):
            if quad.facing * (rays.origin[quad.axis] - quad.at) > 0.0:
                window = _window(quad, rays)
                if window is not None:
                    _intersect(index, quad, rays, window, hits)
    return hits


def _intersect(index: int, quad: Quad, rays: _Rays, window: tuple[slice, slice],
               hits: _Hits) -> None:
    a, b = SPANNED[quad.axis]
    z = rays.inverse[quad.axis][window] * np.float32(quad.at - rays.origin[quad.axis])
    nearest = hits.z[window]
    hit = (z > _NEAR_M) & (z < nearest)
    for along, low, high in zip((a, b), quad.low, quad.high):
        reach = z * rays.direction[along][window]
        hit &= reach >= np.float32(low - rays.origin[along])
        hit &= reach <= np.float32(high - rays.origin[along])
    np.copyto(nearest, z, where=hit)
    np.copyto(hits.quad[window], np.int16(index), where=hit)


def _window(quad: Quad, rays: _Rays) -> tuple[slice, slice] | None:
    """The rows and columns that the rectangle can appear in; None when it cannot."""
    corners = quad.corners() @ rays.T_cam_world[:3, :3].T + rays.T_cam_world[:3, 3]
    corners = _in_front(corners)
    if not len(corners):
        return None
    uv = corners[:, :2] / corners[:, 2:] * np.diag(rays.K)[:2] + rays.K[:2, 2]
    height, width = rays.size
    left, top = np.clip(np.floor(uv.min(0)), 0, (width, height)).astype(int)
    right, bottom = np.clip(np.ceil(uv.max(0)) + 1, 0, (width, height)).astype(int)
    if left >= right or top >= bottom:
        return None
    return slice(top, bottom), slice(left, right)


def _in_front(corners: np.ndarray) -> np.ndarray:
    """A polygon [N,3] in the camera frame, cut at the near plane."""
    if (corners[:, 2] > _NEAR_M).all():
        return corners
    if (corners[:, 2] <= _NEAR_M).all():
        return corners[:0]
    out = []
    for here, following in zip(corners, np.roll(corners, -1, 0)):
        ahead = here[2] > _NEAR_M
        if ahead:
            out.append(here)
        if ahead != (following[2] > _NEAR_M):
            share = (_NEAR_M - here[2]) / (following[2] - here[2])
            out.append(here + share * (following - here))
    return np.array(out)


def _shade(scene: Scene, rays: _Rays, hits: _Hits) -> np.ndarray:
    """[H,W,3] uint8: every texture at the two pyramid levels that fit its distance and slant."""
    z, index = hits.z.ravel(), hits.quad.ravel()
    direction = rays.direction.reshape(3, -1)
    level = _levels(scene, rays, hits).ravel()
    group = index.astype(np.uint16) * _MAX_LEVELS + level.astype(np.uint16)
    order = np.argsort(group, kind='stable')
    bounds = np.flatnonzero(np.diff(group[order].astype(np.int32), prepend=-1, append=-1))
    colour = np.zeros((len(z), 3), np.uint8)
    for start, stop in zip(bounds[:-1], bounds[1:]):
        pixels = order[start:stop]
        if index[pixels[0]] >= 0:
            quad = scene.quads[index[pixels[0]]]
            xy = _texture_xy(quad, rays.origin, z[pixels], direction, pixels)
            colour[pixels] = _sampled(quad, xy, level[pixels])
    return colour.reshape(*rays.size, 3)


def _levels(scene: Scene, rays: _Rays, hits: _Hits) -> np.ndarray:
    """[H,W] float32: the pyramid level whose texels are as large as a sample's footprint."""
    texel = np.array([quad.texel_m for quad in scene.quads], np.float32)
    top = np.array([len(quad.levels) - 1 for quad in scene.quads], np.float32)
    axis = np.array([quad.axis for quad in scene.quads], np.int8).take(hits.quad)
    across = np.abs(np.where(axis == 0, rays.direction[0],
                             np.where(axis == 1, rays.direction[1], rays.direction[2])))
    # A footprint is z/f wide and z/f/cos(slant) long. Between the two lies the compromise of
    # little aliasing and little blur.
    slant = np.sqrt(np.einsum('khw,khw->hw', rays.direction, rays.direction)) / across
    footprint = hits.z / np.float32(rays.K[0, 0]) * slant ** np.float32(0.6)
    with np.errstate(divide='ignore', invalid='ignore'):
        level = np.log2(footprint / texel.take(hits.quad))
    return np.clip(level, 0.0, top.take(hits.quad))


def _texture_xy(quad: Quad, origin: np.ndarray, z: np.ndarray, direction: np.ndarray,
                pixels: np.ndarray) -> np.ndarray:
    """[2,n] float32: where on the rectangle, from 0 to 1 from its top left."""
    a, b = SPANNED[quad.axis]
    right = z * direction[a][pixels] + np.float32(origin[a] - quad.low[0])
    down = np.float32(quad.high[1] - origin[b]) - z * direction[b][pixels]
    return np.stack([right / np.float32(quad.high[0] - quad.low[0]),
                     down / np.float32(quad.high[1] - quad.low[1])])


def _sampled(quad: Quad, xy: np.ndarray, level: np.ndarray) -> np.ndarray:
    """[n,3] uint8, interpolated in the texture and between two levels."""
    lower = int(level[0])
    near = _bilinear(quad.levels[lower], xy)
    if lower + 1 >= len(quad.levels) or level.max() == lower:
        return near
    share = (level - np.float32(lower))[:, None]
    far = _bilinear(quad.levels[lower + 1], xy).astype(np.float32)
    return (near + share * (far - near) + np.float32(0.5)).astype(np.uint8)


def _bilinear(texture: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """[n,3] uint8."""
    count = xy.shape[1]
    rows = -(-count // _ROW)
    maps = np.zeros((2, rows * _ROW), np.float32)
    for i, extent in enumerate((texture.shape[1], texture.shape[0])):
        maps[i, :count] = xy[i] * np.float32(extent) - np.float32(0.5)
    grid = maps.reshape(2, rows, _ROW)
    out = cv2.remap(texture, grid[0], grid[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return out.reshape(-1, 3)[:count]
