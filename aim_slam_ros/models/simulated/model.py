"""A foundation model simulated from the truth: what it sees is right but for known errors."""

from __future__ import annotations

from typing import Sequence

import numpy as np
import torch
from torch import Tensor

from ...geometry import sim3
from ...types import Frame, FrameEncoding, WindowPrediction
from ..classical.features import detect, global_descriptor
from ..truth import TruthProvider
from .confidence import confidence
from .errors import InferenceErrors, ViewErrors
from .levels import ErrorLevels
from .view import SeenView, seen_view

_FEATURES = 800     # of the descriptor


class SimulatedModel:
    """Depth, focal lengths and poses of recorded images, each with the errors of ``levels``.

    The errors of an inference depend on the seed, its first frame and the set of the others.
    A calibrated frame keeps its own K.
    """

    min_views = 1

    def __init__(self, truth: TruthProvider, levels: ErrorLevels, seed: int = 0) -> None:
        self._truth = truth
        self._levels = levels
        self._seed = seed

    def encode(self, frame: Frame) -> FrameEncoding:
        """Raises ValueError for an image of which the truth is not known."""
        truth = self._truth.at(frame.stamp_ns)
        if truth is None:
            raise ValueError(f'the simulated model knows neither depth nor pose of the image with '
                             f'stamp {frame.stamp_ns} ns: give it only images that have both')
        _, sift = detect(frame, _FEATURES)
        return FrameEncoding(frame, global_descriptor(sift),
                             seen_view(truth, frame, self._levels.smear_px))

    def infer(self, encodings: Sequence[FrameEncoding]) -> WindowPrediction:
        frames = [encoding.frame for encoding in encodings]
        if not frames:
            raise ValueError('the simulated model needs at least one view')
        if len({frame.image.shape for frame in frames}) != 1:
            raise ValueError('all views of a window must have the same size')
        window = InferenceErrors(self._levels, self._seed, frames)
        errors = [window.of(frame) for frame in frames]
        views: list[SeenView] = [encoding.features for encoding in encodings]
        scale = window.scale()
        return WindowPrediction(
            torch.from_numpy(np.stack([scale * np.exp(view.log_depth + error.log_depth)
                                       for view, error in zip(views, errors)])),
            torch.from_numpy(np.stack([
                confidence(np.abs(view.smear + error.log_depth), view.known, error.noise)
                for view, error in zip(views, errors)])),
            torch.stack([_intrinsics(*each) for each in zip(frames, views, errors)]),
            _poses(views, errors, scale))


def _intrinsics(frame: Frame, view: SeenView, error: ViewErrors) -> Tensor:
    if frame.K is not None:
        return frame.K.double()
    K = view.K.clone()
    K[:2, :2] *= error.focal
    return K


def _poses(views: Sequence[SeenView], errors: Sequence[ViewErrors], scale: float) -> Tensor:
    """T_first_cam [N,4,4] in the inference's unit; what is wrong is where the others are."""
    T_first_world = sim3.inverse(views[0].T_world_cam)
    T = torch.stack([sim3.identity(), *(
        error.moved(T_first_world @ view.T_world_cam, view.median_depth)
        for view, error in zip(views[1:], errors[1:]))])
    T[:, :3, 3] *= scale
    return T
