"""Feature matches between two frames."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from .features import ClassicalFeatures

_CACHED_PAIRS = 256


@dataclass(frozen=True)
class PairMatches:
    """rows_a, rows_b: [M] int64, matching rows of the two frames' keypoints."""

    rows_a: np.ndarray
    rows_b: np.ndarray

    def swapped(self) -> PairMatches:
        return PairMatches(self.rows_b, self.rows_a)

    def __len__(self) -> int:
        return len(self.rows_a)


class Matcher:
    """Mutual nearest neighbours with a ratio test; remembers the pairs it has matched."""

    def __init__(self, ratio: float) -> None:
        self._ratio = ratio
        self._pairs: OrderedDict[tuple[int, int], PairMatches] = OrderedDict()

    def match(self, a: ClassicalFeatures, b: ClassicalFeatures) -> PairMatches:
        if a.uid > b.uid:
            return self.match(b, a).swapped()
        key = (a.uid, b.uid)
        if key not in self._pairs:
            self._pairs[key] = self._search(a.sift, b.sift)
            if len(self._pairs) > _CACHED_PAIRS:
                self._pairs.popitem(last=False)
        return self._pairs[key]

    def _search(self, a: np.ndarray, b: np.ndarray) -> PairMatches:
        if len(a) < 2 or len(b) < 2:
            return PairMatches(np.zeros(0, np.int64), np.zeros(0, np.int64))
        similarity = torch.from_numpy(a) @ torch.from_numpy(b).T
        best, rows_b = similarity.topk(2, dim=1)
        distance = (2.0 - 2.0 * best).clamp_min(0.0).sqrt()
        backward = similarity.argmax(dim=0)
        rows_a = torch.arange(len(a))
        good = backward[rows_b[:, 0]] == rows_a
        good &= distance[:, 0] <= self._ratio * distance[:, 1]
        return PairMatches(rows_a[good].numpy(), rows_b[good, 0].numpy())


def essential_pose(uv_a: np.ndarray, uv_b: np.ndarray, K_a: Tensor, K_b: Tensor,
                   seed: int) -> tuple[Tensor, np.ndarray] | None:
    """T_b_a [4,4] with a translation of unit length, and inliers [M] bool; None if there is none.

    The essential matrix is found in a common camera with K_a. seed: of the random sampling.
    """
    common = K_a.numpy()
    to_common = common @ np.linalg.inv(K_b.numpy())
    uv_a = np.ascontiguousarray(uv_a, np.float64)
    uv_b = np.ascontiguousarray(uv_b @ to_common[:2, :2].T + to_common[:2, 2], np.float64)
    undistorted = np.zeros(5)
    E, mask = cv2.findEssentialMat(uv_a, uv_b, common, common, undistorted, undistorted,
                                   _magsac(seed))
    if E is None or E.shape != (3, 3):
        return None
    count, R, t, mask = cv2.recoverPose(E, uv_a, uv_b, common, mask=mask)
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3] = torch.from_numpy(R)
    T[:3, 3] = torch.from_numpy(t[:, 0])
    return (T, mask[:, 0] > 0) if count > 0 else None


def _magsac(seed: int) -> cv2.UsacParams:
    """OpenCV's USAC_MAGSAC, with a seed."""
    params = cv2.UsacParams()
    params.confidence, params.threshold, params.maxIterations = 0.999, 1.0, 1000
    params.score, params.sampler = cv2.SCORE_METHOD_MAGSAC, cv2.SAMPLING_UNIFORM
    params.loMethod, params.loIterations, params.loSampleSize = cv2.LOCAL_OPTIM_SIGMA, 10, 50
    params.randomGeneratorState = seed
    return params
