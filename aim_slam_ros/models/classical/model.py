"""The classical geometry model: dense geometry of a few views without learned weights."""

from __future__ import annotations

import itertools
import os
from concurrent.futures import ThreadPoolExecutor
from typing import Sequence

import cv2
import numpy as np
import torch
from torch import Tensor

from ...config import ClassicalConfig
from ...geometry import camera, sim3
from ...types import Frame, FrameEncoding, WindowPrediction
from .features import ClassicalFeatures, contrast_normalised, detect, global_descriptor
from .matches import Matcher
from .relative import SparsePoints, WindowPoses, window_poses
from .sweep import Source, SweepDepth, agreement, fill, sweep

_SOURCES = 3            # at most this many sources per sweep
_FULL_CONFIDENCE = 11.0
_KNOWS_NOTHING = 1.001  # confidence of a depth that is only a prior


class ClassicalModel:
    """SIFT, essential matrix, a small bundle adjustment, plane sweep.

    Its confidence is near 1 wherever the depth is filled in rather than seen, and everywhere when
    the views differ by a rotation alone.
    """

    min_views = 2

    def __init__(self, config: ClassicalConfig, fov_deg: float, seed: int = 0) -> None:
        self._config = config
        self._fov_deg = fov_deg
        self._seed = seed
        self._uids = itertools.count()
        self._matcher = Matcher(config.ratio)
        # OpenCV and numpy release the interpreter lock: the views are swept side by side.
        self._workers = ThreadPoolExecutor(min(4, os.cpu_count() or 1))

    def encode(self, frame: Frame) -> FrameEncoding:
        uv, sift = detect(frame, self._config.features)
        features = ClassicalFeatures(next(self._uids), uv, sift, contrast_normalised(frame))
        return FrameEncoding(frame, global_descriptor(sift), features)

    def infer(self, encodings: Sequence[FrameEncoding]) -> WindowPrediction:
        frames = [e.frame for e in encodings]
        if len(frames) < self.min_views:
            raise ValueError(
                f'the classical model needs {self.min_views} views, not {len(frames)}')
        if len({frame.image.shape for frame in frames}) != 1:
            raise ValueError('all views of a window must have the same size')
        K = [self._intrinsics(frame) for frame in frames]
        features = [e.features for e in encodings]
        poses = window_poses(features, K, self._matcher, self._config, frames[0].width,
                             self._seed)
        depth, confidence = self._dense(frames[0], features, K, poses)
        return WindowPrediction(depth, confidence, torch.stack(K), poses.T_first_view,
                                poses.rotation_only)

    def _intrinsics(self, frame: Frame) -> Tensor:
        if frame.K is not None:
            return frame.K
        return camera.intrinsics_from_fov(frame.width, frame.height, self._fov_deg, frame.aspect)

    def _dense(self, frame: Frame, features: Sequence[ClassicalFeatures], K: Sequence[Tensor],
               poses: WindowPoses) -> tuple[Tensor, Tensor]:
        """Depth and confidence, [N,H,W] float32 each."""
        h, w = features[0].small.shape
        K_small = [camera.scaled(k, w / frame.width, h / frame.height).numpy() for k in K]
        swept = list(self._workers.map(
            lambda i: self._sweep(i, features, K_small, poses), range(len(features))))
        depth, confidence = [], []
        for i, points in enumerate(poses.points):
            score = self._score(i, swept, K_small, poses)
            d, c = _full_size(swept[i], score, points, frame)
            depth.append(d)
            confidence.append(c)
        return torch.from_numpy(np.stack(depth)), torch.from_numpy(np.stack(confidence))

    def _sweep(self, i: int, features: Sequence[ClassicalFeatures], K_small: list[np.ndarray],
               poses: WindowPoses) -> SweepDepth:
        h, w = features[0].small.shape
        sources = self._sources(i, features, K_small, poses)
        if not sources or len(poses.points[i].depth) < 8:
            return SweepDepth(np.ones((h, w), np.float32), np.zeros((h, w), np.float32))
        low, high = np.percentile(1.0 / poses.points[i].depth, (2, 98))
        return sweep(features[i].small, K_small[i], sources, (0.5 * low, 1.4 * high),
                     self._config.planes)

    def _sources(self, i: int, features: Sequence[ClassicalFeatures], K_small: list[np.ndarray],
                 poses: WindowPoses) -> list[Source]:
        """The connected views nearest to a good baseline, a twentieth to a fifth of the depth."""
        if poses.rotation_only or not poses.connected[i]:
            return []
        T_source_ref = sim3.inverse(poses.T_first_view) @ poses.T_first_view[i]
        baseline = T_source_ref[:, :3, 3].norm(dim=1).numpy()
        usable = [j for j in np.flatnonzero(poses.connected).tolist()
                  if j != i and baseline[j] > 0.01]
        usable.sort(key=lambda j: abs(np.log(baseline[j] / 0.12)))
        return [Source(features[j].small, K_small[j], T_source_ref[j].numpy())
                for j in usable[:_SOURCES]]

    def _score(self, i: int, swept: list[SweepDepth], K_small: list[np.ndarray],
               poses: WindowPoses) -> np.ndarray:
        """[h,w] in 0..1: the sweep's own score, times the best agreement with another view."""
        others = [j for j in np.flatnonzero(poses.connected)
                  if j != i and swept[j].score.any()]
        if not others or not swept[i].score.any():
            return swept[i].score * 0.5
        T_other_i = sim3.inverse(poses.T_first_view) @ poses.T_first_view[i]
        best = np.max([agreement(swept[i], K_small[i], swept[j], K_small[j],
                                 T_other_i[j].numpy()) for j in others], axis=0)
        return swept[i].score * best


def _full_size(swept: SweepDepth, score: np.ndarray, points: SparsePoints,
               frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    """Depth and confidence [H,W]: filled, enlarged, with the sparse points written in."""
    size = (frame.width, frame.height)
    rho = fill(swept.rho, score + 1e-4)
    rho = cv2.resize(rho, size, interpolation=cv2.INTER_LINEAR)
    confidence = _KNOWS_NOTHING + (_FULL_CONFIDENCE - 1.0) * cv2.resize(score, size)
    if score.any():
        u = np.clip(np.rint(points.uv[:, 0]).astype(int), 1, frame.width - 2)
        v = np.clip(np.rint(points.uv[:, 1]).astype(int), 1, frame.height - 2)
        for dv, du in itertools.product((-1, 0, 1), repeat=2):
            rho[v + dv, u + du] = 1.0 / points.depth
            confidence[v + dv, u + du] = _FULL_CONFIDENCE
    return 1.0 / np.maximum(rho, 1e-4), confidence.astype(np.float32)
