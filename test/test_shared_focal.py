"""One focal length for a camera, out of what the model says of its images."""

from __future__ import annotations

import math
from dataclasses import replace

import box_room
import numpy as np
import pytest
import torch

from aim_slam_ros.config import KeyframesConfig
from aim_slam_ros.frontend.shared_focal import SharedFocal
from aim_slam_ros.types import Frame, WindowPrediction

T = box_room.trajectory(3)


def _prediction(factor: float, confidence: float = 5.0) -> WindowPrediction:
    """Three views; the model is wrong about the newest one's focal length by this factor."""
    prediction = box_room.prediction(list(T), 1.0)
    prediction = replace(prediction, K=prediction.K.clone())    # else all views have the same one
    prediction.K[0, [0, 1], [0, 1]] *= factor
    prediction.confidence[:] = confidence
    return prediction


def _frame(stamp_ns: int, K: torch.Tensor | None = None) -> Frame:
    return Frame(stamp_ns, np.zeros((box_room.HEIGHT, box_room.WIDTH, 3), np.uint8), K)


def _focal(prediction: WindowPrediction) -> list[float]:
    """Of every view, relative to the true one."""
    return (prediction.K[:, 0, 0] / box_room.K[0, 0]).tolist()


def test_every_view_has_the_mean_of_all_images() -> None:
    shared = SharedFocal(KeyframesConfig())
    assert _focal(shared.applied(_prediction(1.2), _frame(1))) == pytest.approx([1.2] * 3)
    both = shared.applied(_prediction(0.9), _frame(2))
    assert _focal(both) == pytest.approx([math.sqrt(1.2 * 0.9)] * 3)
    assert torch.equal(both.K[:, :2, 2], _prediction(1.0).K[:, :2, 2]), 'its centre stays'


def test_2_percent_an_image_is_a_fifth_of_that_after_25() -> None:
    """The deviation of the mean of 25 draws is .4 %; three times that is allowed."""
    shared, rng = SharedFocal(KeyframesConfig()), np.random.default_rng(0)
    for stamp_ns in range(1, 26):
        got = shared.applied(_prediction(math.exp(0.02 * rng.standard_normal())),
                             _frame(stamp_ns))
    assert _focal(got) == pytest.approx([1.0] * 3, abs=0.012)


def test_an_image_that_is_asked_about_again_counts_once() -> None:
    shared = SharedFocal(KeyframesConfig())
    shared.applied(_prediction(1.0), _frame(1))
    for _ in range(3):
        again = shared.applied(_prediction(1.21), _frame(2))
    assert _focal(again) == pytest.approx([1.1] * 3)


def test_an_image_of_which_nothing_was_seen_does_not_count() -> None:
    shared = SharedFocal(KeyframesConfig())
    unseen = _prediction(1.5, confidence=1.0)
    assert shared.applied(unseen, _frame(1)) is unseen
    shared.applied(_prediction(1.1), _frame(2))
    assert _focal(shared.applied(unseen, _frame(3))) == pytest.approx([1.1] * 3)


def test_a_calibrated_camera_keeps_its_own() -> None:
    shared, prediction = SharedFocal(KeyframesConfig()), _prediction(1.3)
    assert shared.applied(prediction, _frame(1, box_room.K)) is prediction


def test_the_papers_way_leaves_every_view_its_own() -> None:
    shared = SharedFocal(KeyframesConfig(shared_focal=False))
    prediction = _prediction(1.3)
    assert shared.applied(prediction, _frame(1)) is prediction
