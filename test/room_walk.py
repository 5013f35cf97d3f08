"""Keyframes of a walk once around the rendered room, and a model that knows their geometry.

Images and depths are the renderer's; only the geometry model is simulated: true depth and poses in
an arbitrary unit per inference, with smooth depth errors and pose errors.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Sequence

import cv2
import numpy as np
import torch
from torch import Tensor

from aim_slam_ros.datasets.raycast import View, render_view
from aim_slam_ros.datasets.room import room
from aim_slam_ros.geometry import camera, sim3
from aim_slam_ros.types import (Frame, FrameEncoding, KeyframeEvent, PoseEdge, WindowPrediction)

WIDTH, HEIGHT = 259, 196
K = camera.intrinsics(212.0, 212.0, 129.0, 97.5)
STEP = 10               # frames between keyframes


@dataclass(frozen=True)
class Place:
    """One keyframe's true view. T_world_cam: rigid [4,4] float64; depth: [H,W] float32, metres."""

    stamp_ns: int
    image: np.ndarray
    depth: Tensor
    T_world_cam: Tensor


@lru_cache(maxsize=1)
def places() -> tuple[Place, ...]:
    """33 views; the last ones see what the first ones saw."""
    scene = room(np.random.default_rng(0))
    chosen = range(0, len(scene.stamps_ns), STEP)
    views = [render_view(scene, scene.T_world_cam[i], K.numpy(), (WIDTH, HEIGHT)) for i in chosen]
    return tuple(_place(int(scene.stamps_ns[i]), view, scene.T_world_cam[i])
                 for i, view in zip(chosen, views))


def _place(stamp_ns: int, view: View, T_world_cam: np.ndarray) -> Place:
    return Place(stamp_ns, view.image, torch.from_numpy(view.depth), torch.from_numpy(T_world_cam))


def warped(depth: Tensor, rng: np.random.Generator, relative: float) -> Tensor:
    """Depth [H,W] with a smooth relative error, as a network's."""
    coarse = rng.standard_normal((5, 6)).astype(np.float32)
    smooth = cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    return depth * torch.from_numpy(np.exp(relative * smooth))


def descriptor(image: np.ndarray) -> Tensor:
    """A tiny grey image without its mean, L2-normalised: similar views are similar."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    tiny = cv2.resize(grey, (12, 9), interpolation=cv2.INTER_AREA).astype(np.float32)
    flat = torch.from_numpy(tiny - tiny.mean()).reshape(-1)
    return flat / flat.norm()


class RoomModel:
    """The simulated model: it recognises a frame by its stamp.

    lie: stamps whose pose it gets wrong, as a model does with a view of another place.
    """

    min_views = 2

    def __init__(self, lie: Sequence[int] = ()) -> None:
        self._places = {p.stamp_ns: p for p in places()}
        self._rng = np.random.default_rng(3)
        self._lie = set(lie)
        self.inferences = 0
        self.encoded: list[int] = []

    def encode(self, frame: Frame) -> FrameEncoding:
        self.encoded.append(frame.stamp_ns)
        return FrameEncoding(frame, descriptor(frame.image), None)

    def infer(self, encodings: Sequence[FrameEncoding]) -> WindowPrediction:
        self.inferences += 1
        seen = [self._places[e.frame.stamp_ns] for e in encodings]
        unit = math.exp(0.3 * self._rng.standard_normal())
        depth = torch.stack([warped(p.depth, self._rng, 0.03) for p in seen]) / unit
        T_world = torch.stack([p.T_world_cam for p in seen])
        for i, place in enumerate(seen):
            if place.stamp_ns in self._lie:
                T_world[i] = seen[0].T_world_cam
        T_first = sim3.inverse(T_world[0]) @ T_world @ sim3.exp(self._pose_errors(len(seen)))
        T_first[:, :3, 3] /= unit
        return WindowPrediction(depth, torch.full(depth.shape, 5.0), K.expand(len(seen), 3, 3),
                                T_first)

    def _pose_errors(self, count: int) -> Tensor:
        """[N,7]: 0.4 degrees and 4 cm per view, none for the first."""
        xi = torch.from_numpy(self._rng.standard_normal((count, 7)))
        xi *= torch.tensor([0.04 / 3 ** 0.5] * 3 + [0.007 / 3 ** 0.5] * 3 + [0.0])
        xi[0] = 0.0
        return xi


def units(count: int) -> list[float]:
    """Metres in the unit of each keyframe; the first's is 1."""
    values = np.exp(0.2 * np.random.default_rng(1).standard_normal(count))
    return [1.0, *values[1:].tolist()]


def true_poses(indices: Sequence[int]) -> Tensor:
    """T_world_kf [N,4,4] in metres, each with its keyframe's unit."""
    return torch.stack([sim3.with_scale(places()[i].T_world_cam, units(len(places()))[i])
                        for i in indices])


def drifting_events(scale_drift: float, piece_from: int | None = None) -> list[KeyframeEvent]:
    """The walk's events as a drifting frontend would send them.

    scale_drift: log-scale error gathered over the walk. piece_from: the keyframe at which the
    frontend lost its way and began a map piece with a world of its own.
    """
    truth = true_poses(range(len(places())))
    bias = torch.zeros(7, dtype=torch.float64)
    bias[6] = scale_drift / len(truth)
    bias[4] = 0.03 / len(truth)
    sigma = torch.tensor([0.05] * 3 + [0.006] * 3 + [0.02], dtype=torch.float64)
    T_world = truth[0]
    events = []
    for i in range(len(truth)):
        edges: tuple[PoseEdge, ...] = ()
        if i == piece_from:
            T_world = sim3.identity()
        elif i:
            T_measured = sim3.exp(bias) @ sim3.inverse(truth[i - 1]) @ truth[i]
            T_world = T_world @ T_measured
            edges = (PoseEdge(i - 1, i, T_measured, sigma),)
        events.append(event(i, T_world, edges, int(piece_from is not None and i >= piece_from)))
    return events


def event(index: int, T_world_kf: Tensor, edges: tuple[PoseEdge, ...] = (),
          piece_id: int = 0) -> KeyframeEvent:
    """The event of one place, its pointmap in its own unit, 3 % wrong."""
    place = places()[index]
    depth = warped(place.depth, np.random.default_rng(index), 0.03) / units(len(places()))[index]
    return KeyframeEvent(index, piece_id, place.stamp_ns, place.image, K,
                         camera.unproject(depth, K), torch.full(tuple(depth.shape), 5.0),
                         T_world_kf, descriptor(place.image), edges)


def ate(T_estimated: Tensor, T_true: Tensor) -> float:
    """RMSE of the positions of [N,4,4] each, after the best similarity transform."""
    a, b = T_estimated[:, :3, 3], T_true[:, :3, 3]
    a0, b0 = a - a.mean(0), b - b.mean(0)
    U, S, Vh = torch.linalg.svd(b0.T @ a0)
    flip = torch.ones(3, dtype=torch.float64)
    flip[2] = torch.det(U @ Vh).sign()
    scale = (S * flip).sum() / (a0 ** 2).sum()
    return float(((b0 - scale * a0 @ (U @ torch.diag(flip) @ Vh).T) ** 2).sum(1).mean().sqrt())
