"""The way of the camera, wherever its keyframes are moved to later."""

from __future__ import annotations

import threading
from collections import Counter
from typing import Mapping

import numpy as np
import torch
from torch import Tensor

from ..geometry import sim3
from ..types import StampedPoses

_FIRST_CAPACITY = 1024


class CorrectedPath:
    """Every tracked frame in its keyframe, which is what survives a correction.

    One thread may add while another asks for the poses.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._row: dict[int, int] = {}
        self._stamps_ns = np.empty(_FIRST_CAPACITY, np.int64)
        self._reference = np.empty(_FIRST_CAPACITY, np.int64)
        self._T_kf_cam = np.empty((_FIRST_CAPACITY, 4, 4))

    def __len__(self) -> int:
        return len(self._row)

    def add(self, stamp_ns: int, reference_id: int, T_kf_cam: Tensor) -> None:
        """A tracked frame, in any order; one with a stamp that is known replaces the earlier.

        T_kf_cam: [4,4] float64, rigid, in the keyframe's unit.
        """
        with self._lock:
            row = self._row.setdefault(stamp_ns, len(self._row))
            if row == len(self._stamps_ns):
                self._grow()
            self._stamps_ns[row] = stamp_ns
            self._reference[row] = reference_id
            self._T_kf_cam[row] = T_kf_cam.numpy()

    def largest_piece(self, pieces: Mapping[int, int]) -> int | None:
        """The map piece with most frames; pieces: of every known keyframe."""
        with self._lock:
            reference = self._reference[:len(self._row)].copy()
        return _largest_piece(reference, pieces)

    def poses(self, T_world_kf: Mapping[int, Tensor], pieces: Mapping[int, int]) -> StampedPoses:
        """In time order, from the keyframes' poses [4,4] and their map pieces.

        Only frames of the largest piece: poses of unconnected pieces have no common world. A
        frame whose keyframe is not given is left out.
        """
        with self._lock:
            count = len(self._row)
            stamps_ns = self._stamps_ns[:count].copy()
            reference, T_kf_cam = self._reference[:count].copy(), self._T_kf_cam[:count].copy()
        largest = _largest_piece(reference, pieces)
        ids = np.array(sorted(k for k in T_world_kf if pieces.get(k) == largest), np.int64)
        rows = np.flatnonzero(np.isin(reference, ids))
        rows = rows[np.argsort(stamps_ns[rows])]
        if largest is None or not len(rows):
            return StampedPoses(np.zeros(0, np.int64), np.zeros((0, 4, 4)))
        keyframes = torch.stack([T_world_kf[k] for k in ids.tolist()])
        T_world = keyframes[np.searchsorted(ids, reference[rows])]
        poses = sim3.rigid_part(T_world @ torch.from_numpy(T_kf_cam[rows]))
        return StampedPoses(stamps_ns[rows], poses.numpy())

    def _grow(self) -> None:
        """Double the storage, so that adding costs constant time on average."""
        self._stamps_ns, self._reference, self._T_kf_cam = (
            np.concatenate([old, np.empty_like(old)])
            for old in (self._stamps_ns, self._reference, self._T_kf_cam))


def _largest_piece(reference: np.ndarray, pieces: Mapping[int, int]) -> int | None:
    frames: Counter[int] = Counter()
    for keyframe_id, count in zip(*(v.tolist() for v in np.unique(reference,
                                                                  return_counts=True))):
        if keyframe_id in pieces:
            frames[pieces[keyframe_id]] += count
    return frames.most_common(1)[0][0] if frames else None
