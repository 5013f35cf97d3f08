"""A tracked image becomes a keyframe, and the window's keyframes learn from the inference."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Mapping

import numpy as np
import torch
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
from torch import Tensor

from ..config import KeyframesConfig
from ..geometry import camera, sim3
from ..types import (Frame, FrameEncoding, Keyframe, KeyframeEvent, KeyframePose,
                     PoseEdge, WindowPrediction)
from .alignment import observed
from .following import Followed
from .initialisation import Beginning
from .keyframe_map import KeyframeMap
from .window import WindowEstimate

_CARRIED = 1.2        # confidence of a depth carried over from older keyframes, at its points
_BETWEEN = 1.02       # and between them
_COARSE_PX = 4        # distance of the pixels where it is interpolated
_BETTER = 3           # so many times the observations that loop closure was told of: worth telling
_AT_ONCE = 3          # keyframes told once more beside a new one, megabytes each
_EDGE_SIGMA = (0.02, 0.02, 0.02, 0.006, 0.006, 0.006, 0.02)   # translation by median depth


class Promotion:
    """Writes new keyframes and fused observations into the map."""

    def __init__(self, config: KeyframesConfig, keyframes: KeyframeMap) -> None:
        self._config = config
        self._map = keyframes
        self._edges: dict[int, tuple[PoseEdge, ...]] = {}
        self._told: dict[int, int] = {}     # observations

    def begin(self, beginning: Beginning) -> list[Keyframe]:
        """The first keyframes of a piece: the oldest view is the world, then the current one."""
        prediction = beginning.prediction
        if beginning.measured and len(beginning.encodings) > 1:
            T_world_current = sim3.inverse(prediction.T_first_cam[1])
            return [self._add(beginning.encodings[1], prediction, 1, sim3.identity()),
                    self._add(beginning.encodings[0], prediction, 0, T_world_current)]
        return [self._add(beginning.encodings[0], prediction, 0, sim3.identity())]

    def promote(self, encoding: FrameEncoding, followed: Followed, estimate: WindowEstimate,
                K: Tensor) -> Keyframe | None:
        """A keyframe with the inference's own depth, its unit in the pose's scale.

        Where the inference did not measure any (motion without parallax, for a model that needs
        it), with the depth of the followed points; None where there are none either.
        """
        if self.has_depth(estimate):
            return self._add(encoding, estimate.prediction, 0, estimate.result.T_world_frame)
        if not followed.ok:
            return None
        device = estimate.prediction.depth.device
        points, confidence = (image.to(device)
                              for image in _carried(encoding.frame, followed, K))
        return self._map.add(encoding, K, points, confidence, followed.T_world_cam)

    def has_depth(self, estimate: WindowEstimate) -> bool:
        """Whether the inference measured the image's depth, so that a keyframe takes it over."""
        prediction = estimate.prediction
        return (estimate.ok and not prediction.rotation_only
                and prediction.seen_share(0) >= self._config.min_confident)

    def _add(self, encoding: FrameEncoding, prediction: WindowPrediction, view: int,
             T_world_kf: Tensor) -> Keyframe:
        points = camera.unproject(prediction.depth[view], prediction.K[view])
        return self._map.add(encoding, prediction.K[view], points, prediction.confidence[view],
                             T_world_kf)

    def learn(self, estimate: WindowEstimate) -> None:
        """Move the window's keyframes where the tracker put them and fuse their new depths."""
        self._map.move([KeyframePose(i, T) for i, T in estimate.result.moved.items()])
        for view, keyframe in enumerate(estimate.keyframes, 1):
            self._map.fuse(observed(self._map[keyframe.keyframe_id], estimate.prediction, view,
                                    self._config))

    def event(self, keyframe: Keyframe, measured: Mapping[int, Tensor],
              reference_id: int) -> KeyframeEvent:
        """What loop closure is told, with an edge to the reference and to all that measured it.

        measured: T_older_keyframe as each older keyframe alone sees it. A short edge is what the
        map has, the joint solution; over a long one that would repeat the drift between its ends.
        """
        T_kf_world = sim3.inverse(keyframe.T_world_kf)
        edges = []
        for i in sorted({reference_id, *measured} - {keyframe.keyframe_id}):
            T = sim3.inverse(T_kf_world @ self._map[i].T_world_kf)
            if i in measured and keyframe.keyframe_id - i > self._config.long_edge:
                T = measured[i]
            edges.append(_edge(self._map[i], keyframe.keyframe_id, T))
        self._edges[keyframe.keyframe_id] = tuple(edges)
        return replace(self.repeated_event(keyframe),
                       moved=self._map.take_moved(keyframe.keyframe_id))

    def refined(self) -> list[KeyframeEvent]:
        """Keyframes that are known much better than loop closure was told, the most so first."""
        growth = {i: self._map[i].observations / told for i, told in self._told.items()}
        most = sorted(growth, key=lambda i: -growth[i])[:_AT_ONCE]
        return [self.repeated_event(self._map[i]) for i in most if growth[i] >= _BETTER]

    def repeated_event(self, keyframe: Keyframe) -> KeyframeEvent:
        """The event once more, as the keyframe is now, with the edges as they were measured."""
        self._told[keyframe.keyframe_id] = keyframe.observations
        return KeyframeEvent(
            keyframe.keyframe_id, keyframe.piece_id, keyframe.stamp_ns, keyframe.frame.image,
            keyframe.K, keyframe.points_cam.cpu(), keyframe.confidence.cpu(), keyframe.T_world_kf,
            keyframe.encoding.descriptor, self._edges[keyframe.keyframe_id],
            observations=keyframe.observations)


def _edge(older: Keyframe, newer_id: int, T_older_newer: Tensor) -> PoseEdge:
    sigma = torch.tensor(_EDGE_SIGMA, dtype=torch.float64)
    sigma[:3] *= older.median_depth
    return PoseEdge(older.keyframe_id, newer_id, T_older_newer, sigma)


def _carried(frame: Frame, followed: Followed, K: Tensor) -> tuple[Tensor, Tensor]:
    """Pointmap [H,W,3] and confidence [H,W] from sparse points, linear between them."""
    T_cam_world = sim3.inverse(followed.T_world_cam)
    z = sim3.transform(T_cam_world, torch.from_numpy(followed.points_world))[:, 2].numpy()
    front = z > 0
    uv, rho = followed.uv[front].astype(np.float64), 1.0 / z[front]
    # From border to border: the resampling then puts every sample where it was taken.
    rows, columns = (np.linspace(0.0, length - 1.0, math.ceil(length / _COARSE_PX))
                     for length in (frame.height, frame.width))
    v, u = np.meshgrid(rows, columns, indexing='ij')
    coarse = LinearNDInterpolator(uv, rho)(u, v)
    outside = np.isnan(coarse)
    coarse[outside] = NearestNDInterpolator(uv, rho)(u[outside], v[outside])
    grid = torch.nn.functional.interpolate(
        torch.from_numpy(coarse)[None, None].float(), (frame.height, frame.width),
        mode='bilinear', align_corners=True)[0, 0]
    confidence = torch.full(grid.shape, _BETWEEN)
    at = np.rint(uv).astype(np.int64)
    confidence[at[:, 1], at[:, 0]] = _CARRIED
    confidence = torch.nn.functional.max_pool2d(confidence[None, None], 5, 1, 2)[0, 0]
    return camera.unproject(1.0 / grid, K), confidence
