"""A short rendered clip of the room, with the noise of a camera, and keyframes of known geometry.

The classical model and the frontend need real image texture; the truth is the renderer's.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from aim_slam_ros.config import CameraConfig, Config, KeyframesConfig, SigmaConfig
from aim_slam_ros.datasets import load_sequence
from aim_slam_ros.datasets.rendered import render
from aim_slam_ros.frontend.admission import Admission
from aim_slam_ros.frontend.keyframe_map import KeyframeMap
from aim_slam_ros.frontend.promotion import Promotion
from aim_slam_ros.geometry import camera, sim3
from aim_slam_ros.types import Frame, FrameEncoding, Keyframe

SIZE = (320, 240)
WIDTH = 322         # what the model sees, a multiple of 14
FRAMES = slice(0, 132, 3)


@dataclass(frozen=True)
class Clip:
    """images: N times [H,W,3] uint8. depth: [N,H,W] float32, metres. T_world_cam: [N,4,4].

    K: [3,3] numpy, pixels of the images.
    """

    stamps_ns: list[int]
    images: list[np.ndarray]
    depth: list[np.ndarray]
    T_world_cam: Tensor
    K: np.ndarray

    def __len__(self) -> int:
        return len(self.images)

    def frame(self, index: int) -> Frame:
        """As the frontend admits it, with its calibration."""
        admission = Admission(CameraConfig(width=WIDTH, use_calibration=True))
        frame = admission.admit(self.stamps_ns[index], self.images[index], self.K)
        assert isinstance(frame, Frame), frame
        return frame

    def depth_of(self, index: int) -> Tensor:
        """[H,W] float32 of the admitted frame, metres."""
        frame = self.frame(index)
        resized = cv2.resize(self.depth[index], (frame.width, frame.height),
                             interpolation=cv2.INTER_NEAREST)
        return torch.from_numpy(resized)

    def T_a_b(self, a: int, b: int) -> Tensor:
        """The true pose of camera b in camera a, metres."""
        return sim3.inverse(self.T_world_cam[a]) @ self.T_world_cam[b]


def make(folder: Path) -> Clip:
    """Render it (some seconds)."""
    render('room', folder, frames=FRAMES, size=SIZE)
    sequence = load_sequence(folder)
    truth, count = sequence.groundtruth, len(sequence)
    assert truth is not None and sequence.K is not None
    depths = [sequence.depth(i) for i in range(count)]
    return Clip([int(s) for s in sequence.stamps_ns], [sequence.image(i) for i in range(count)],
                [d for d in depths if d is not None], torch.from_numpy(truth.T_world_cam),
                sequence.K)


def config(**values: object) -> Config:
    """The defaults for small images; ``section__name=value`` sets one."""
    settings = {'camera.width': str(WIDTH), 'camera.use_calibration': 'true'}
    settings |= {name.replace('__', '.'): str(value) for name, value in values.items()}
    return Config().with_values(settings)


def tiny_descriptor(image: np.ndarray) -> Tensor:
    """A tiny grey image without its mean, L2-normalised."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    tiny = cv2.resize(grey, (12, 9), interpolation=cv2.INTER_AREA).astype(np.float32)
    flat = torch.from_numpy(tiny - tiny.mean()).reshape(-1)
    return flat / flat.norm()


def encoding(clip: Clip, index: int) -> FrameEncoding:
    frame = clip.frame(index)
    return FrameEncoding(frame, tiny_descriptor(frame.image), None)


def add_keyframe(keyframes: KeyframeMap, clip: Clip, index: int, unit: float = 1.0) -> Keyframe:
    """The clip's image with its true depth in units of ``unit`` metres."""
    frame = clip.frame(index)
    assert frame.K is not None
    points = camera.unproject(clip.depth_of(index) / unit, frame.K)
    T_world_kf = sim3.with_scale(clip.T_world_cam[index], unit)
    return keyframes.add(encoding(clip, index), frame.K, points,
                         torch.full(points.shape[:2], 5.0), T_world_kf)


def true_map(clip: Clip, indices: list[int], units: tuple[float, ...] = ()) -> KeyframeMap:
    keyframes = KeyframeMap(SigmaConfig())
    for k, index in enumerate(indices):
        add_keyframe(keyframes, clip, index, units[k] if units else 1.0)
    return keyframes


def promotion(keyframes: KeyframeMap) -> Promotion:
    return Promotion(KeyframesConfig(), keyframes)


def noise(seed: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    """An image of nothing that the clip shows, [H,W,3] uint8."""
    coarse = np.random.default_rng(seed).integers(0, 256, (size[1] // 4, size[0] // 4, 3))
    return cv2.resize(coarse.astype(np.uint8), size, interpolation=cv2.INTER_CUBIC)


def turned(image: np.ndarray, K: np.ndarray, rotation: tuple[float, float, float]) -> np.ndarray:
    """The image [H,W,3] of a camera that only turned by this axis-angle vector [rad]."""
    R = cv2.Rodrigues(np.array(rotation))[0]
    return cv2.warpPerspective(image, K @ R @ np.linalg.inv(K), image.shape[1::-1],
                               flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
