"""VGGT as a geometry model."""

from __future__ import annotations

import itertools
import logging
import threading
from typing import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from ...types import Frame, FrameEncoding, WindowPrediction
from .network import Vggt, VggtOutput
from .prediction import window_prediction
from .sizes import PATCH_PX
from .tokens import FrameTokens, TokenCache

_log = logging.getLogger(__name__)


class VggtModel:
    """Windows from encodings; what an image needs only once is computed once.

    One thread works at a time, others wait: a node that begins a new map may still have an
    inference under way, and memory is for one.
    cached_frames: images whose tokens are kept on the device (each 8.5 to 12.8 MB at a width
    of 518); those of others are made again when they are needed. fov_deg: assumed where nothing is
    known.
    """

    min_views = 1

    def __init__(self, network: Vggt, cached_frames: int, fov_deg: float) -> None:
        self._network = network
        self._fov_deg = fov_deg
        self._cache = TokenCache(cached_frames)
        self._uids = itertools.count()
        self._lock = threading.Lock()
        self._most_views: int | None = None    # what fits into memory, once that is known

    def encode(self, frame: Frame) -> FrameEncoding:
        """Raises ValueError for an image whose sides are not multiples of 14."""
        if frame.width % PATCH_PX or frame.height % PATCH_PX:
            raise ValueError(f'an image of {frame.width}x{frame.height} has sides that are no '
                             f'multiples of {PATCH_PX}: resize it as admission does')
        tokens = FrameTokens(next(self._uids), frame)
        with self._lock:
            return FrameEncoding(frame, self._described(tokens), tokens)

    def _described(self, tokens: FrameTokens) -> Tensor:
        """[C] float32: the mean patch token, normalised. Of no view's role, so always the same."""
        patches = None
        try:
            patches = tokens.patches(self._network)
        except torch.OutOfMemoryError:
            pass    # not in here: the error still holds on to the tensors of the attempt
        if patches is None:
            self._make_room()
            patches = tokens.patches(self._network)
        self._cache.used(tokens)
        return F.normalize(patches.mean(0), dim=0).cpu()

    def infer(self, encodings: Sequence[FrameEncoding],
              depth_views: Sequence[int] | None = None) -> WindowPrediction:
        """depth_views: the views whose depth is wanted, None for all; others know nothing.

        Where the GPU's memory does not suffice, the last views are left out and know nothing.
        """
        frames = [encoding.frame for encoding in encodings]
        if not frames:
            raise ValueError('VGGT needs at least one view')
        if len({frame.image.shape for frame in frames}) != 1:
            raise ValueError('all views of a window must have the same size')
        wanted = range(len(frames)) if depth_views is None else depth_views
        with self._lock:
            output, views = self._fitting([e.features for e in encodings], wanted)
        return window_prediction(output, frames, views, self._fov_deg)

    def _fitting(self, tokens: Sequence[FrameTokens],
                 wanted: Sequence[int]) -> tuple[VggtOutput, list[int]]:
        """The output for as many views as fit, and those that have a depth."""
        offered = count = min(len(tokens), self._most_views or len(tokens))
        roomy = False       # whether everything that could be dropped has been
        while True:
            views = [i for i in wanted if i < count]
            try:
                output = self._run(tokens[:count], views)
                break
            except torch.OutOfMemoryError:
                if roomy and count == 1:
                    raise
            self._make_room()
            count -= roomy
            roomy = True
        if count < offered:
            self._remember(count)
        return output, views

    def _run(self, tokens: Sequence[FrameTokens], views: Sequence[int]) -> VggtOutput:
        begun = torch.stack([one.begun(self._network, first=i == 0)
                             for i, one in enumerate(tokens)])
        for one in tokens:
            self._cache.used(one)
        return self._network(begun, tokens[0].grid, views)

    def _make_room(self) -> None:
        self._cache.clear()
        if torch.cuda.is_available():
            torch.cuda.empty_cache()

    def _remember(self, count: int) -> None:
        self._most_views = count
        _log.warning(
            'out of GPU memory: from now on the model sees at most %d views at a time. For more, '
            'close other programs on the GPU and start again, or make the images smaller '
            '(camera.width)', count)
