"""The map of one run of the frontend."""

from __future__ import annotations

from typing import Mapping

import numpy as np
import torch
from torch import Tensor

from ...config import Config
from ...geometry import sim3
from ...loop_closure.corrected_path import CorrectedPath
from ...loop_closure.map_from_odom import MapFromOdom
from ...loop_closure.pipeline import LoopClosurePipeline
from ...models.base import GeometryModel
from ...types import Cloud, CorrectedKeyframes, FrameReport, KeyframeEvent, StampedPoses
from .keyframe_gaps import KeyframeGaps


class MapSession:
    """Frames and keyframes with the same session id.

    Two threads: the callbacks' places frames, the worker's adds keyframes and asks for what
    follows from them. Between them stand ``_T_world_kf`` and ``_T_map_kf``, which the worker
    replaces as a whole. The map is the piece with most frames: others have no place in it yet.
    """

    def __init__(self, session_id: int, config: Config, model: GeometryModel, gap_s: float,
                 path: CorrectedPath | None = None) -> None:
        """path: of the frames before, where the same run's map is begun again."""
        self.session_id = session_id
        self.gaps = KeyframeGaps(gap_s)
        self.forgotten = False          # another map is current; what still waits is not worked on
        self.path = path or CorrectedPath()
        self._pipeline = LoopClosurePipeline(config, model)
        self._from_odom = MapFromOdom()
        self._T_world_kf: Mapping[int, Tensor] = {}
        self._T_map_kf: Mapping[int, Tensor] = {}
        self._pieces = 0
        self._stamps_ns: dict[int, int] = {}

    @property
    def pipeline(self) -> LoopClosurePipeline:
        """For what it knows; ``add`` alone changes it."""
        return self._pipeline

    @property
    def stamps_ns(self) -> Mapping[int, int]:
        """Of every keyframe's image."""
        return self._stamps_ns

    @property
    def keyframes(self) -> int:
        """How many there are."""
        return len(self._T_world_kf)

    @property
    def pieces(self) -> int:
        """How many parts of the map are not connected with each other."""
        return self._pieces

    def place(self, report: FrameReport) -> Tensor | None:
        """T_map_cam [4,4] float64, rigid, of a tracked frame; None of another.

        Where the keyframe is not in the map (yet), odom's last known place in the map decides.
        """
        result, T_odom_cam = report.result, report.T_odom_cam
        if result.reference_id is not None:
            self.gaps.exists(result.reference_id)
        if T_odom_cam is None:
            return None
        if result.reference_id is None or result.T_kf_cam is None:
            return self._from_odom.place(T_odom_cam)
        self.path.add(result.stamp_ns, result.reference_id, result.T_kf_cam)
        T_map_kf = self._T_map_kf.get(result.reference_id)
        if T_map_kf is None:
            return self._from_odom.place(T_odom_cam)
        return self._from_odom.learn(result.reference_id, T_map_kf, result.T_kf_cam, T_odom_cam)

    def knows(self, keyframe_id: int) -> bool:
        return keyframe_id in self._T_world_kf

    def wants(self, event: KeyframeEvent) -> bool:
        """Whether the keyframe is new, or known better than when it came."""
        return self._pipeline.wants(event)

    def add(self, event: KeyframeEvent) -> CorrectedKeyframes | None:
        """As LoopClosurePipeline.add; raises PoseGraphError or RetrievalError."""
        self._stamps_ns[event.keyframe_id] = event.stamp_ns
        try:
            return self._pipeline.add(event)
        finally:
            pieces, piece = self._pipeline.pieces, self._piece()
            self._T_world_kf = {p.keyframe_id: p.T_world_kf for p in self._pipeline.poses}
            self._T_map_kf = {k: T for k, T in self._T_world_kf.items() if pieces[k] == piece}
            self._pieces = len(set(pieces.values()))

    def trajectory(self) -> StampedPoses:
        """Every frame of the largest connected piece, corrected."""
        return self.path.poses(self._T_world_kf, self._pipeline.pieces)

    def keyframe_trajectory(self) -> StampedPoses:
        """The keyframes of the same piece by their stamps, without their scales."""
        pieces, piece = self._pipeline.pieces, self._piece()
        ids = sorted((k for k in self._T_world_kf if pieces[k] == piece),
                     key=self._stamps_ns.__getitem__)
        poses = torch.stack([self._T_world_kf[k] for k in ids])
        return StampedPoses(np.array([self._stamps_ns[k] for k in ids], np.int64),
                            sim3.rigid_part(poses).numpy())

    def cloud(self) -> Cloud:
        """The fused map, in the world's unit."""
        return self._pipeline.fused_map(self._piece())

    def _piece(self) -> int | None:
        """Which piece the map is; None before the first keyframe."""
        piece = self.path.largest_piece(self._pipeline.pieces)
        # No frame may have come since this node was started.
        return self._pipeline.largest_piece if piece is None else piece
