"""The network's output as a window's geometry, on the CPU and always finite."""

from __future__ import annotations

import math
from typing import Sequence

import torch
from torch import Tensor

from ...geometry import camera, sim3
from ...types import Frame, WindowPrediction
from . import pose_encoding
from .network import VggtOutput

_KNOWS_NOTHING = 1.0
_FOV_RAD = (math.radians(2.0), math.radians(170.0))   # outside, a camera is nonsense
_DEPTH = (1e-6, 1e6)
_MAX_CONFIDENCE = 1e6


def window_prediction(output: VggtOutput, frames: Sequence[Frame],
                      depth_views: Sequence[int], fov_deg: float) -> WindowPrediction:
    """All frames, also those that the network did not see or was not asked the depth of.

    Re-anchored: the network's first view is nearly, not exactly, its world. The focal length is
    the camera's own where the frame is calibrated. fov_deg: assumed where nothing is known.
    """
    encoding = output.pose_rounds[-1].detach().cpu().double()
    sound = _sound(encoding)
    return WindowPrediction(*_dense(output, frames, depth_views, sound),
                            _intrinsics(encoding, frames, sound, fov_deg),
                            _poses(encoding, frames, sound))


def _sound(encoding: Tensor) -> Tensor:
    """[N] bool: views whose camera is one; the first must be, since it carries the others."""
    fov = encoding[:, 7:]
    sound = (torch.isfinite(encoding).all(1) & (encoding[:, 3:7].norm(dim=1) > 1e-6)
             & (fov > _FOV_RAD[0]).all(1) & (fov < _FOV_RAD[1]).all(1))
    return sound & sound[0]


def _poses(encoding: Tensor, frames: Sequence[Frame], sound: Tensor) -> Tensor:
    """T_first_cam [N,4,4]; the identity for a view that is not sound."""
    T = torch.eye(4, dtype=torch.float64).repeat(len(frames), 1, 1)
    T_cam_world = pose_encoding.extrinsics(encoding)
    for i in sound.nonzero()[:, 0].tolist():
        if i:
            T[i] = T_cam_world[0] @ sim3.inverse(T_cam_world[i])
    return T


def _intrinsics(encoding: Tensor, frames: Sequence[Frame], sound: Tensor,
                fov_deg: float) -> Tensor:
    """[N,3,3] float64, pixels of the frame's image."""
    predicted = pose_encoding.intrinsics(encoding, frames[0].height, frames[0].width)
    K = []
    for i, frame in enumerate(frames):
        if frame.K is not None:
            K.append(frame.K.double())
        elif i < len(sound) and sound[i]:
            K.append(predicted[i])
        else:
            K.append(camera.intrinsics_from_fov(frame.width, frame.height, fov_deg, frame.aspect))
    return torch.stack(K)


def _dense(output: VggtOutput, frames: Sequence[Frame], depth_views: Sequence[int],
           sound: Tensor) -> tuple[Tensor, Tensor]:
    """Depth and confidence, [N,H,W] float32 each."""
    shape = (len(frames), frames[0].height, frames[0].width)
    depth, confidence = torch.ones(shape), torch.full(shape, _KNOWS_NOTHING)
    known = [k for k, view in enumerate(depth_views) if sound[view]]
    if known:
        views = [depth_views[k] for k in known]
        depth[views], confidence[views] = _finite(output.depth.cpu()[known].float(),
                                                  output.confidence.cpu()[known].float())
    return depth, confidence


def _finite(depth: Tensor, confidence: Tensor) -> tuple[Tensor, Tensor]:
    """The same, with depth 1 and no confidence where the depth is none."""
    good = (depth > _DEPTH[0]) & (depth < _DEPTH[1]) & ~confidence.isnan()
    confidence = confidence.clamp(_KNOWS_NOTHING, _MAX_CONFIDENCE)
    return torch.where(good, depth, 1.0), torch.where(good, confidence, _KNOWS_NOTHING)
