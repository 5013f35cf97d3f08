"""Which images enter, and in what shape."""

from __future__ import annotations

import re

import numpy as np
import pytest
import torch

from aim_slam_ros.config import CameraConfig
from aim_slam_ros.frontend.admission import Admission
from aim_slam_ros.types import Frame

CONFIG = CameraConfig(width=518)
K = np.array([[525.0, 0.0, 319.5], [0.0, 525.0, 239.5], [0.0, 0.0, 1.0]])


def _image(height: int = 480, width: int = 640) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (height, width, 3)).astype(np.uint8)


def _admitted(image: np.ndarray, K: np.ndarray | None = None,
              config: CameraConfig = CONFIG) -> Frame:
    frame = Admission(config).admit(1, image, K)
    assert isinstance(frame, Frame), frame
    return frame


@pytest.mark.parametrize('size, expected', [((480, 640), (392, 518)), ((480, 752), (336, 518)),
                                            ((240, 320), (392, 518)), ((376, 1241), (154, 518)),
                                            ((900, 300), (518, 518)), ((32, 5000), (14, 518))])
def test_sides_become_multiples_of_a_patch(size: tuple[int, int],
                                           expected: tuple[int, int]) -> None:
    """As VGGT's preprocessing: width 518, height round(h 518/w/14) 14, at least one patch, of what
    is higher than wide the middle."""
    frame = _admitted(_image(*size))
    assert (frame.height, frame.width) == expected
    assert frame.image.dtype == np.uint8 and frame.image.shape == (*expected, 3)


def test_intrinsics_follow_the_resize() -> None:
    """The corner of the image stays the corner: pixel centres are at integers."""
    frame = _admitted(_image(480, 752), K, CameraConfig(width=518, use_calibration=True))
    assert frame.K is not None
    sx, sy = 518 / 752, 336 / 480
    assert frame.K[0, 0] == pytest.approx(525 * sx) and frame.K[1, 1] == pytest.approx(525 * sy)
    left, top = (-0.5 - frame.K[:2, 2]) / frame.K.diagonal()[:2]
    assert float(left) == pytest.approx((-0.5 - 319.5) / 525)
    assert float(top) == pytest.approx((-0.5 - 239.5) / 525)
    assert frame.aspect == pytest.approx(float(frame.K[1, 1] / frame.K[0, 0]))


def test_calibration_is_used_only_where_asked_for_and_known() -> None:
    assert _admitted(_image(), K, CameraConfig(use_calibration=False)).K is None
    assert _admitted(_image(), None, CameraConfig(use_calibration=True)).K is None


def test_the_colours_stay_where_they_are() -> None:
    image = np.zeros((480, 640, 3), np.uint8)
    image[:, :320, 0], image[:, 320:, 2] = 250, 250
    small = _admitted(image).image
    assert small[200, 100].tolist() == [250, 0, 0] and small[200, 400].tolist() == [0, 0, 250]


@pytest.mark.parametrize('image, reason', [
    (np.zeros((480, 640, 3), np.uint8), 'constant'),
    (np.full((480, 640, 3), 255, np.uint8), 'constant'),
    (np.full((480, 640, 3), 77, np.uint8), 'constant'),
    (_image(20, 20), 'too small'), (_image(0, 640), 'too small'),
    (_image(480, 4), 'too small'), (_image()[..., 0], r'\[H,W,3\]'),
    (np.zeros((480, 640, 4), np.uint8), r'\[H,W,3\]'), (_image().astype(np.float32), 'float32'),
    (_image().astype(np.uint16), 'uint16')])
def test_what_cannot_be_used_is_refused_with_a_reason(image: np.ndarray, reason: str) -> None:
    got = Admission(CONFIG).admit(1, image, None)
    assert isinstance(got, str) and re.search(reason, got), got


def test_a_map_keeps_its_image_size() -> None:
    admission = Admission(CONFIG)
    admission.admit(1, _image(), None)
    assert '320x240' in str(admission.admit(2, _image(240, 320), None))
    assert isinstance(admission.admit(3, _image(), None), Frame)


@pytest.mark.parametrize('stamp_ns', [5, 4, -1])
def test_stamps_must_grow(stamp_ns: int) -> None:
    admission = Admission(CONFIG)
    admission.admit(5, _image(), None)
    got = admission.admit(stamp_ns, _image(), None)
    assert isinstance(got, str) and f'{stamp_ns} ns is not newer' in got


def test_a_refused_image_leaves_no_trace() -> None:
    """Neither its size nor its stamp count."""
    admission = Admission(CONFIG)
    assert isinstance(admission.admit(100, np.zeros((100, 100, 3), np.uint8), None), str)
    assert isinstance(admission.admit(1, _image(), None), Frame)
    assert isinstance(admission.admit(100, np.zeros((480, 640, 3), np.uint8), None), str)
    assert isinstance(admission.admit(2, _image(), None), Frame)


def test_dim_but_textured_images_enter() -> None:
    """Night is not black."""
    assert isinstance(Admission(CONFIG).admit(1, _image() // 20, None), Frame)


def test_a_view_into_a_larger_buffer_enters() -> None:
    """A flipped or cropped image, as drivers hand them over, is not contiguous."""
    assert isinstance(Admission(CONFIG).admit(1, _image()[::-1, ::-1], None), Frame)
    assert torch.from_numpy(_admitted(_image()).image).is_contiguous()
