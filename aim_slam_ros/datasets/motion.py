"""Camera paths for the rendered scenes."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

_UP = np.array([0.0, 0.0, 1.0])


def looking(position: np.ndarray, forward: np.ndarray) -> np.ndarray:
    """Poses [N,4,4] float64 of upright cameras at [N,3] that look along [N,3]."""
    z = forward / np.linalg.norm(forward, axis=1, keepdims=True)
    x = np.cross(z, _UP)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    T_world_cam = np.tile(np.eye(4), (len(position), 1, 1))
    T_world_cam[:, :3, :3] = np.stack([x, np.cross(z, x), z], -1)
    T_world_cam[:, :3, 3] = position
    return T_world_cam


def wander(rng: np.random.Generator, time_s: np.ndarray, columns: int,
           period_s: float) -> np.ndarray:
    """[N,columns] smooth random motion of about unit deviation, a new value every period."""
    knots = np.arange(-1, time_s[-1] / period_s + 3.0) * period_s
    return CubicSpline(knots, rng.standard_normal((len(knots), columns)))(time_s)


def hand_held(rng: np.random.Generator, time_s: np.ndarray, T_world_cam: np.ndarray,
              sway_m: float, shake_m: float, shake_rad: float) -> np.ndarray:
    """The path as a person walks it: sway with the steps, and an unsteady hand.

    sway_m: amplitude to the sides (0.9 Hz) and, at half of it, up and down (1.8 Hz).
    """
    phase = 2.0 * np.pi * 0.9 * time_s
    shift = shake_m * wander(rng, time_s, 3, 0.35)
    shift[:, 0] += sway_m * np.sin(phase)
    shift[:, 1] += 0.5 * sway_m * np.sin(2.0 * phase + 0.7)
    turn = shake_rad * wander(rng, time_s, 3, 0.45)
    out = T_world_cam.copy()
    out[:, :3, 3] += np.einsum('nij,nj->ni', T_world_cam[:, :3, :3], shift)
    out[:, :3, :3] = T_world_cam[:, :3, :3] @ Rotation.from_rotvec(turn).as_matrix()
    return out


def rounded_loop(half: tuple[float, float], radius: float, step: float) -> np.ndarray:
    """[N,2] points ``step`` apart once around a rectangle with round corners, anticlockwise.

    Starts where the lower side begins, just after a corner.
    """
    hx, hy = half[0] - radius, half[1] - radius
    angles = np.linspace(0.0, 0.5 * np.pi, 50)
    arc = radius * np.stack([np.sin(angles), -np.cos(angles)], 1)
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    corners = [arc + (hx, -hy), arc @ turn.T + (hx, hy),
               arc @ (turn @ turn).T + (-hx, hy), arc @ (turn @ turn @ turn).T + (-hx, -hy)]
    outline = np.concatenate([[(-hx, -half[1])], *corners])
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(outline, axis=0), axis=1))])
    at = np.arange(0.0, lengths[-1], step)
    return np.stack([np.interp(at, lengths, outline[:, i]) for i in range(2)], 1)


def heading(points: np.ndarray, smoothing: float) -> np.ndarray:
    """[N] radians, unwrapped: the direction of a closed line of points, smoothed along it."""
    step = np.roll(points, -1, 0) - points
    angle = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    slope = 2.0 * np.pi * np.arange(len(angle)) / len(angle)
    return gaussian_filter1d(angle - slope, smoothing, mode='wrap') + slope
