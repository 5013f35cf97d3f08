"""Frozen types that travel between rooms.

Conventions, everywhere: ``T_a_b`` is a Sim(3) of frame b in frame a, stored as a 4x4 float64
tensor ``[[s R, t], [0, 1]]``, so that ``p_a = T_a_b @ p_b`` and neighbours cancel. Cameras follow
OpenCV (x right, y down, z forward); pixel centres are at integers. Lengths are in the unit of the
frame they are expressed in: a monocular map has no metres of its own.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cached_property
from typing import Any, Mapping

import cv2
import numpy as np
import torch
from torch import Tensor


GUESSED_CONFIDENCE = 1.05   # a depth with less confidence is filled in, not seen


@dataclass(frozen=True)
class Frame:
    """One admitted image, resized to the model's input size.

    image: [H,W,3] uint8, RGB.
    K: [3,3] float64, pixels of ``image``; None where the camera is uncalibrated.
    aspect: fy/fx of ``image`` for a camera with square pixels (the resize is anisotropic).
    """

    stamp_ns: int
    image: np.ndarray
    K: Tensor | None = None
    aspect: float = 1.0

    @cached_property
    def grey(self) -> np.ndarray:
        """[H,W] uint8."""
        return cv2.cvtColor(self.image, cv2.COLOR_RGB2GRAY)

    @property
    def height(self) -> int:
        return self.image.shape[0]

    @property
    def width(self) -> int:
        return self.image.shape[1]


@dataclass(frozen=True)
class FrameEncoding:
    """What a geometry model computes once per frame and keeps with its keyframe.

    descriptor: [D] float32, L2-normalised; for loop retrieval by cosine similarity.
    features: whatever the model that made it reuses; opaque to everybody else.
    """

    frame: Frame
    descriptor: Tensor
    features: Any


@dataclass(frozen=True)
class WindowPrediction:
    """One inference over N views (the current frame first), in its own arbitrary unit.

    depth: [N,H,W] float32, along the optical axis.
    confidence: [N,H,W] float32, > 1; near 1 means that the model knows nothing there.
    K: [N,3,3] float64, pixels.
    T_first_cam: [N,4,4] float64, rigid; the first is the identity.
    rotation_only: the views differ by a rotation alone; depth is a prior, not a measurement.
    """

    depth: Tensor
    confidence: Tensor
    K: Tensor
    T_first_cam: Tensor
    rotation_only: bool = False

    def to(self, device: torch.device) -> WindowPrediction:
        """With the images there; cameras stay on the CPU, where single matrices belong."""
        return replace(self, depth=self.depth.to(device), confidence=self.confidence.to(device))

    def seen_share(self, view: int) -> float:
        """Share of the view's pixels whose depth was seen; 0 for a view that did not connect."""
        return float((self.confidence[view, ::4, ::4] > GUESSED_CONFIDENCE).float().mean())


@dataclass(frozen=True)
class Keyframe:
    """A keyframe with its fused pointmap, in its own unit (T_world_kf carries the scale).

    K: [3,3] float64. points_cam: [H,W,3] float32. confidence: [H,W] float32, accumulated over
    every observation fused so far, ``observations`` of them.
    """

    keyframe_id: int
    piece_id: int
    encoding: FrameEncoding
    K: Tensor
    points_cam: Tensor
    confidence: Tensor
    T_world_kf: Tensor
    observations: int = 1

    @property
    def frame(self) -> Frame:
        return self.encoding.frame

    @cached_property
    def median_depth(self) -> float:
        """In its own unit."""
        return float(self.points_cam[::8, ::8, 2].median())

    @cached_property
    def mean_confidence(self) -> float:
        return float(self.confidence[::4, ::4].mean())

    @property
    def stamp_ns(self) -> int:
        return self.encoding.frame.stamp_ns


@dataclass(frozen=True)
class KeyframePose:
    """A keyframe's pose in the world: T_world_kf [4,4] float64, with its scale."""

    keyframe_id: int
    T_world_kf: Tensor


@dataclass(frozen=True)
class PoseEdge:
    """A measured relative pose T_a_b ([4,4] float64) between keyframes a and b.

    sigma: [7] float64, standard deviations in the tangent (translation in units of keyframe a,
    rotation in radians, log-scale).
    """

    a: int
    b: int
    T_a_b: Tensor
    sigma: Tensor


@dataclass(frozen=True)
class KeyframeEvent:
    """A new keyframe, or a known one that was seen more often, as loop closure is told of it.

    image: [H,W,3] uint8 RGB, all that is needed to run the model on it again. points_cam and
    confidence as in Keyframe. edges: the relative poses to the older keyframes it was tracked
    against, as measured (a loop-closure correction does not change them). moved: older keyframes
    whose pose changed in the frontend since the last event. observations: how many inferences the
    pointmap is the mean of.
    """

    keyframe_id: int
    piece_id: int
    stamp_ns: int
    image: np.ndarray
    K: Tensor
    points_cam: Tensor
    confidence: Tensor
    T_world_kf: Tensor
    descriptor: Tensor
    edges: tuple[PoseEdge, ...] = ()
    moved: tuple[KeyframePose, ...] = ()
    observations: int = 1


@dataclass(frozen=True)
class CorrectedKeyframes:
    """All keyframe poses after a pose-graph optimisation; version counts up from 1.

    pieces: the map piece of every keyframe; a loop between two pieces makes the newer one part of
    the older.
    """

    version: int
    poses: tuple[KeyframePose, ...]
    pieces: Mapping[int, int] = field(default_factory=dict)


class TrackingStatus(Enum):
    """What became of an image."""

    INITIALISING = 'initialising'   # no map yet: waiting for parallax
    TRACKED = 'tracked'             # has a pose
    LOST = 'lost'                   # could not be placed in the map
    SKIPPED = 'skipped'             # not usable: black, constant, tiny, not newer than the last


@dataclass(frozen=True)
class FrameResult:
    """The frontend's answer to one image.

    T_world_cam: [4,4] float64, rigid, in the frontend's world; None unless TRACKED.
    reference_id, T_kf_cam: the keyframe it was tracked against and the pose in its frame (in the
    keyframe's unit, rigid): what survives a later correction of the keyframe.
    events: the keyframes that this image led to. window: keyframe ids of the inference, if any.
    kappa: reduced chi-square of the window, as its tracker defines it. stage_s: seconds spent in
    each stage.
    late: images that waited for the map to begin and were placed in it now, oldest first.
    reason: why it was skipped or lost, for a person.
    """

    stamp_ns: int
    status: TrackingStatus
    T_world_cam: Tensor | None = None
    reference_id: int | None = None
    T_kf_cam: Tensor | None = None
    piece_id: int = 0
    events: tuple[KeyframeEvent, ...] = ()
    window: tuple[int, ...] = ()
    kappa: float | None = None
    inferences: int = 0
    matched_fraction: float = 0.0
    stage_s: Mapping[str, float] = field(default_factory=dict)
    late: tuple[FrameResult, ...] = ()
    reason: str = ''


@dataclass(frozen=True)
class FrameReport:
    """What other processes are told about one image.

    session_id: of the run of the frontend; keyframe ids are unique within one. T_odom_cam: [4,4]
    float64, rigid, in the odom frame with its axes as the first camera has them (OpenCV); None
    unless TRACKED. result: its T_world_cam, events, late and reason do not travel. dropped:
    images that found the frontend busy, so far.
    """

    session_id: int
    result: FrameResult
    T_odom_cam: Tensor | None = None
    dropped: int = 0


@dataclass(frozen=True)
class StampedPoses:
    """A trajectory. stamps_ns: [N] int64, increasing. T_world_cam: [N,4,4] float64, rigid."""

    stamps_ns: np.ndarray
    T_world_cam: np.ndarray

    def __len__(self) -> int:
        return len(self.stamps_ns)


@dataclass(frozen=True)
class Cloud:
    """A coloured point cloud. points: [N,3] float32; colours: [N,3] uint8 RGB."""

    points: np.ndarray
    colours: np.ndarray
