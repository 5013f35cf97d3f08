"""The keyframes: their world poses, their pointmaps, and who sees what (sole writer of all)."""

from __future__ import annotations

from dataclasses import replace
from typing import Mapping, Sequence

import torch
from torch import Tensor

from ..config import SigmaConfig
from ..geometry import sim3
from ..types import CorrectedKeyframes, FrameEncoding, Keyframe, KeyframePose
from .sigma import candidates
from .voxel_index import VoxelIndex, confident_points, relative_voxel_size

_MOVED = 0.02   # of the median depth: a keyframe that moved less stays in its voxels


class KeyframeMap:
    """Keyframes in pieces: the keyframes of one piece share a world, two pieces do not."""

    def __init__(self, config: SigmaConfig) -> None:
        self._config = config
        self._keyframes: dict[int, Keyframe] = {}
        self._piece_ids: list[int] = []
        self._moved: set[int] = set()
        self._descriptors: list[Tensor] = []
        self.piece_id = self.pieces_begun = 0
        self._index: VoxelIndex | None = None
        self._indexed_at: dict[int, Tensor] = {}    # T_world_kf

    def __getitem__(self, keyframe_id: int) -> Keyframe:
        return self._keyframes[keyframe_id]

    @property
    def all(self) -> tuple[Keyframe, ...]:
        """Every keyframe of every piece, oldest first."""
        return tuple(self._keyframes.values())

    @property
    def piece(self) -> tuple[Keyframe, ...]:
        """The keyframes of the current piece, oldest first."""
        return tuple(self._keyframes[i] for i in self._piece_ids)

    def begin_piece(self) -> None:
        """Start a new, unconnected map; the first piece needs no call."""
        self.piece_id = self.pieces_begun = self.pieces_begun + 1
        self._piece_ids = []
        self._index = None
        self._indexed_at.clear()

    def add(self, encoding: FrameEncoding, K: Tensor, points_cam: Tensor, confidence: Tensor,
            T_world_kf: Tensor) -> Keyframe:
        """A new keyframe; the points in its own unit, the scale in its pose."""
        # A view would keep the whole inference in memory.
        keyframe = Keyframe(len(self._keyframes), self.piece_id, encoding, K.clone(),
                            points_cam.contiguous(), confidence.clone(), T_world_kf)
        self._keyframes[keyframe.keyframe_id] = keyframe
        self._piece_ids.append(keyframe.keyframe_id)
        self._descriptors.append(encoding.descriptor)
        if self._index is None:
            self._index = VoxelIndex(relative_voxel_size(keyframe, self._config))
        self._insert(self._index, keyframe)
        return keyframe

    def fuse(self, keyframe: Keyframe) -> None:
        """Take over a keyframe whose pointmap has grown by an observation."""
        self._keyframes[keyframe.keyframe_id] = keyframe

    def move(self, poses: Sequence[KeyframePose]) -> None:
        """New poses T_world_kf found by tracking; they are told with the next event."""
        self._place(poses)
        self._moved.update(pose.keyframe_id for pose in poses)

    def take_moved(self, except_id: int) -> tuple[KeyframePose, ...]:
        """What tracking moved since the last call."""
        moved = sorted(self._moved - {except_id})
        self._moved.clear()
        return tuple(KeyframePose(i, self._keyframes[i].T_world_kf) for i in moved)

    def correct(self, corrected: CorrectedKeyframes) -> None:
        """Take the poses of a pose-graph optimisation, and the pieces that it joined.

        Keyframes of the current piece that it does not know yet, or has not connected with the
        others yet, move along with the newest one that it knows.
        """
        poses = {p.keyframe_id: p.T_world_kf for p in corrected.poses
                 if p.keyframe_id in self._keyframes}
        anchor = max((i for i in self._piece_ids if i in poses), default=None)
        if anchor is not None:
            piece_id = corrected.pieces.get(anchor)
            T_new_old = poses[anchor] @ sim3.inverse(self._keyframes[anchor].T_world_kf)
            poses |= {i: T_new_old @ self._keyframes[i].T_world_kf for i in self._piece_ids
                      if i not in poses or corrected.pieces.get(i) != piece_id}
        self._place([KeyframePose(i, T) for i, T in poses.items()])
        self._join(corrected.pieces, anchor)

    def _place(self, poses: Sequence[KeyframePose]) -> None:
        for pose in poses:
            keyframe = replace(self._keyframes[pose.keyframe_id], T_world_kf=pose.T_world_kf)
            self._keyframes[pose.keyframe_id] = keyframe
            if self._index is not None and pose.keyframe_id in self._index \
                    and _displacement(keyframe, self._indexed_at[pose.keyframe_id]) > _MOVED:
                self._index.move(pose.keyframe_id, confident_points(keyframe, self._config))
                self._indexed_at[pose.keyframe_id] = pose.T_world_kf

    def _join(self, pieces: Mapping[int, int], anchor: int | None) -> None:
        """Take over which piece each keyframe is in; the current piece may have become older."""
        if anchor is not None and anchor in pieces:
            current = pieces[anchor]
            pieces = dict(pieces) | {i: current for i in self._piece_ids}
            self.piece_id = current
        for i, piece_id in pieces.items():
            if i in self._keyframes and self._keyframes[i].piece_id != piece_id:
                self._keyframes[i] = replace(self._keyframes[i], piece_id=piece_id)
        if anchor is None:
            return
        ids = [i for i, k in self._keyframes.items() if k.piece_id == self.piece_id]
        if ids != self._piece_ids:
            self._piece_ids = ids
            self._reindex()

    def _reindex(self) -> None:
        """Anew, since the joined piece may have a unit of its own."""
        first = self._keyframes[self._piece_ids[0]]
        self._index = VoxelIndex(relative_voxel_size(first, self._config))
        self._indexed_at.clear()
        for keyframe in self.piece:
            self._insert(self._index, keyframe)

    def _insert(self, index: VoxelIndex, keyframe: Keyframe) -> None:
        index.insert(keyframe.keyframe_id, confident_points(keyframe, self._config))
        self._indexed_at[keyframe.keyframe_id] = keyframe.T_world_kf

    def overlapping(self, keyframe_id: int) -> tuple[Keyframe, ...]:
        """The piece's other keyframes by shared voxels, most first (paper, SIGMA a)."""
        if self._index is None:
            return ()
        return tuple(self._keyframes[i]
                     for i in candidates(self._index, keyframe_id, self._config))

    def similar(self, descriptor: Tensor, count: int) -> list[Keyframe]:
        """Keyframes of the current piece by descriptor similarity, best first."""
        if not self._piece_ids:
            return []
        table = torch.stack([self._descriptors[i] for i in self._piece_ids])
        best = (table @ descriptor).topk(min(count, len(table))).indices
        return [self._keyframes[self._piece_ids[int(i)]] for i in best]


def _displacement(keyframe: Keyframe, T_world_before: Tensor) -> float:
    """How far the middle of what it sees moved from there, relative to its distance."""
    middle = keyframe.points_cam[::8, ::8].reshape(-1, 3).nanmedian(dim=0).values.cpu().double()
    a, b = (sim3.transform(T, middle) for T in (T_world_before, keyframe.T_world_kf))
    reach = (a - sim3.translation_of(T_world_before)).norm().clamp_min(1e-9)
    return float((a - b).norm() / reach)
