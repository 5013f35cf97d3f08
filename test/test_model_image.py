"""The network's image and K on both sides of the resize."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import Image

from aim_slam_ros.geometry import camera
from aim_slam_ros.geometry.model_image import model_image

SIZES = [(480, 640), (480, 752), (200, 300), (376, 1241), (640, 480), (32, 2000)]


def _image(height: int, width: int) -> np.ndarray:
    """Smooth colours with noise on top."""
    v, u = np.mgrid[:height, :width].astype(np.float64)
    smooth = np.stack([100 + 90 * np.sin(u / 17), 120 + 80 * np.cos(v / 11), (u + v) % 255], -1)
    noise = np.random.default_rng(0).normal(0, 12, smooth.shape)
    return (smooth + noise).clip(0, 255).astype(np.uint8)


@pytest.mark.parametrize('size', SIZES)
def test_it_is_what_the_official_preprocessing_gives(size: tuple[int, int]) -> None:
    """PIL's bicubic at width 518 and a height in patches, then the middle 518 rows."""
    image = _image(*size)
    height = max(1, round(size[0] * (518 / size[1]) / 14)) * 14
    expected = np.asarray(Image.fromarray(image).resize((518, height), Image.Resampling.BICUBIC))
    start = max(0, (height - 518) // 2)
    expected = expected[start:start + 518]
    got = model_image(image, 518).image
    assert got.shape == expected.shape and got.flags['C_CONTIGUOUS']
    difference = np.abs(got.astype(int) - expected)
    # the same filter with its weights rounded elsewhere: rarely a grey level, never more than 2
    assert difference.max() <= 2 and difference.mean() < 0.05


@pytest.mark.parametrize('size', SIZES)
def test_K_maps_the_same_ray_to_the_same_place(size: tuple[int, int]) -> None:
    """A pixel of the camera's image, moved by the resize and the cut, keeps its ray."""
    resized = model_image(_image(*size), 518)
    K = camera.intrinsics(525.0, 520.0, 0.52 * size[1], 0.47 * size[0])
    u, v = 0.3 * size[1], 0.8 * size[0]
    ray = torch.linalg.inv(K) @ torch.tensor([u, v, 1.0], dtype=torch.float64)
    moved = resized.K_model(K) @ ray
    # pixel centres are at integers, so that the image begins at -0.5
    assert float(moved[0]) == pytest.approx((u + 0.5) * resized.scale_x - 0.5)
    assert float(moved[1]) == pytest.approx((v + 0.5) * resized.scale_y - 0.5 - resized.top_px)


def test_a_read_only_image_is_taken() -> None:
    image = _image(48, 64)
    image.flags.writeable = False
    assert model_image(image, 84).image.shape == (56, 84, 3)
