"""What two inferences over one image say, averaged."""

from __future__ import annotations

from dataclasses import replace

import box_room
import pytest
import torch

from aim_slam_ros.frontend.merging import merged
from aim_slam_ros.geometry import sim3
from aim_slam_ros.types import WindowPrediction

VIEWS = list(box_room.trajectory(4))
NARROW_UNIT, WIDE_UNIT = 0.6, 1.7


def _narrow(**errors: object) -> WindowPrediction:
    return replace(box_room.prediction(VIEWS[:3], NARROW_UNIT), **errors)   # type: ignore


def _wide() -> WindowPrediction:
    return box_room.prediction(VIEWS, WIDE_UNIT)


def test_two_that_are_right_give_the_wider_one_in_its_own_unit() -> None:
    """To float32; the new view is as it was, and what both saw counts for more."""
    wide, got = _wide(), merged(_wide(), _narrow())
    assert torch.allclose(got.depth, wide.depth, rtol=1e-5)
    assert torch.allclose(got.T_first_cam, wide.T_first_cam, atol=1e-6)
    assert torch.allclose(got.confidence[:3] - 1.0, 2.0 * (wide.confidence[:3] - 1.0))
    assert torch.equal(got.confidence[3], wide.confidence[3])
    assert torch.equal(got.K, wide.K)


@pytest.mark.parametrize('weight, share', [(4.0, 0.5), (8.0, 2 / 3), (2.0, 1 / 3)])
def test_an_error_of_one_counts_by_its_confidence(weight: float, share: float) -> None:
    """Of a rotation, and of the log depth in a quarter of the image, which leaves the median."""
    depth, T = _narrow().depth.clone(), _narrow().T_first_cam.clone()
    corner = (0, slice(0, box_room.HEIGHT // 2), slice(0, box_room.WIDTH // 2))
    depth[corner] *= 1.1
    turn = sim3.exp(torch.tensor([0, 0, 0, 0, 0.03, 0, 0], dtype=torch.float64))
    T[2] = T[2] @ turn
    confidence = torch.full_like(depth, 1.0 + weight)
    wide = _wide()
    assert float(wide.confidence.max()) == float(wide.confidence.min()) == 5.0
    got = merged(wide, _narrow(depth=depth, T_first_cam=T, confidence=confidence))
    assert torch.allclose(got.depth[corner] / wide.depth[corner], torch.tensor(1.1 ** share),
                          rtol=1e-4)
    assert torch.allclose(got.depth[1], wide.depth[1], rtol=1e-5)
    angle = sim3.angle_rad(got.T_first_cam[2], wide.T_first_cam[2])
    assert angle == pytest.approx(0.03 * share, rel=1e-3)


def test_independent_errors_shrink() -> None:
    """5 per cent of noise a pixel: half of its square is left where two were averaged."""
    truth = _wide().depth
    noisy = merged(box_room.prediction(VIEWS, WIDE_UNIT, 0.05, seed=1),
                   box_room.prediction(VIEWS[:3], NARROW_UNIT, 0.05, seed=2))
    rms = (noisy.depth / truth).log().square().mean((1, 2)).sqrt()
    # tens of thousands of pixels, and a unit from medians
    assert rms[:3].tolist() == pytest.approx([0.05 / 2 ** 0.5] * 3, rel=0.05)
    assert float(rms[3]) == pytest.approx(0.05, rel=0.05)


def test_two_guesses_are_no_observation() -> None:
    guess = torch.full_like(_wide().confidence, 1.04)
    got = merged(replace(_wide(), confidence=guess), _narrow(confidence=guess[:3]))
    assert torch.allclose(got.confidence, guess)


@pytest.mark.parametrize('which', ['wide', 'narrow', 'nothing seen'])
def test_without_depth_in_both_the_wider_one_stays(which: str) -> None:
    wide, narrow = _wide(), _narrow()
    if which == 'wide':
        wide = replace(wide, rotation_only=True)
    elif which == 'narrow':
        narrow = replace(narrow, rotation_only=True)
    else:
        narrow = replace(narrow, confidence=torch.ones_like(narrow.confidence))
    assert merged(wide, narrow) is wide
