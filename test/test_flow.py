"""Predicted matches refined in the images: known shifts of a textured image."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from aim_slam_ros.registration.flow import LEVELS, TIGHT_LEVELS, refine

SHIFT = np.array([5.3, -3.6], np.float32)


def _texture(seed: int = 0) -> np.ndarray:
    """[H,W] uint8, smooth enough for sub-pixel work."""
    image = np.random.default_rng(seed).integers(0, 256, (60, 80)).astype(np.uint8)
    return cv2.resize(image, (320, 240), interpolation=cv2.INTER_CUBIC)


def _shifted(image: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """What was at p is at p + shift."""
    matrix = np.array([[1, 0, shift[0]], [0, 1, shift[1]]], np.float32)
    return cv2.warpAffine(image, matrix, image.shape[::-1], flags=cv2.INTER_CUBIC,
                          borderMode=cv2.BORDER_REFLECT)


def _grid(border: int = 40) -> np.ndarray:
    u, v = np.meshgrid(np.arange(border, 320 - border, 20), np.arange(border, 240 - border, 20))
    return np.stack([u.ravel(), v.ravel()], 1).astype(np.float32)


def test_a_shift_is_found_to_a_fraction_of_a_pixel() -> None:
    image, uv = _texture(), _grid()
    wrong = uv + SHIFT + np.array([2.0, 3.0], np.float32)
    got = refine(image, _shifted(image, SHIFT), uv, wrong, levels=TIGHT_LEVELS)
    assert got.valid.mean() > 0.95
    # rounding to grey levels leaves a few hundredths of a pixel
    assert np.abs(got.uv_b - uv - SHIFT)[got.valid].max() < 0.1


def test_the_prediction_is_left_as_it_was() -> None:
    image, uv = _texture(), _grid()
    predicted = uv.copy()
    refine(image, _shifted(image, SHIFT), uv, predicted)
    assert (predicted == uv).all()


def test_the_whole_pyramid_reaches_farther() -> None:
    image, uv = _texture(), _grid(60)
    # texture of every size, as the world has it, or there is nothing to see in the upper levels
    blurred = [cv2.GaussianBlur(image.astype(np.float32), (0, 0), s) * s for s in (1, 4, 12, 24)]
    image = cv2.normalize(np.sum(blurred, 0), None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    shift = np.array([38.0, 21.0], np.float32)
    moved = _shifted(image, shift)

    def right(levels: int) -> float:
        got = refine(image, moved, uv, uv, max_move_px=90.0, levels=levels)
        return float((got.valid & (np.abs(got.uv_b - uv - shift).max(1) < 0.5)).mean())

    assert right(LEVELS) > 0.8 > 0.3 > right(0)


def test_a_match_far_from_its_prediction_is_refused() -> None:
    image, uv = _texture(), _grid()
    moved = _shifted(image, SHIFT)
    assert refine(image, moved, uv, uv, max_move_px=8.0).valid.mean() > 0.9
    assert not refine(image, moved, uv, uv, max_move_px=5.0).valid.any()


def test_what_is_covered_does_not_flow_back() -> None:
    image, uv = _texture(), _grid()
    covered = image.copy()
    covered[:, 160:] = _texture(seed=1)[:, 160:]
    right = uv[:, 0] > 175
    checked = refine(image, covered, uv, uv).valid
    unchecked = refine(image, covered, uv, uv, max_round_trip_px=None).valid
    assert checked[uv[:, 0] < 145].all()
    assert checked[right].mean() < 0.2 < 0.6 < unchecked[right].mean()


@pytest.mark.parametrize('where', [(np.nan, 5.0), (np.inf, 5.0), (-1.0, 5.0), (5.0, 240.0)])
def test_a_prediction_outside_the_image_gives_no_match(where: tuple[float, float]) -> None:
    image, uv = _texture(), _grid()
    predicted = uv.copy()
    predicted[3] = where
    got = refine(image, image, uv, predicted)
    assert not got.valid[3] and got.valid.sum() == len(uv) - 1


def test_no_points_and_no_texture_give_no_matches() -> None:
    image, none = _texture(), np.zeros((0, 2), np.float32)
    assert len(refine(image, image, none, none).valid) == 0
    flat, uv = np.full_like(image, 90), _grid()
    assert not refine(flat, flat, uv, uv).valid.any()
