"""The points of a keyframe that are looked for in images."""

from __future__ import annotations

from dataclasses import replace

import clip as clips
import numpy as np
import pytest
import torch
from clip import Clip

from aim_slam_ros.config import FollowingConfig
from aim_slam_ros.frontend.landmarks import (
    followed_corners, matched_grid, relative_depth_sigma)
from aim_slam_ros.types import GUESSED_CONFIDENCE, Keyframe

SIDE = 15       # px, what 24 px at a width of 518 are at the clip's


def _dotted(clip: Clip) -> tuple[Keyframe, np.ndarray]:
    """Flat grey with a small cross in each square, at a place of its own; where they are, u v."""
    keyframe = clips.true_map(clip, [10])[0]
    frame = keyframe.frame
    rows, columns = frame.height // SIDE, frame.width // SIDE
    first = np.array([(frame.width - columns * SIDE) // 2, (frame.height - rows * SIDE) // 2])
    corner = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), -1).reshape(-1, 2) * SIDE
    at = first + corner + np.random.default_rng(0).integers(5, SIDE - 5, corner.shape)
    image = np.full_like(frame.image, 60)
    for u, v in at:
        image[v - 1:v + 2, u - 1:u + 2] = 220
    flat = torch.ones_like(keyframe.points_cam)
    return replace(keyframe, points_cam=flat, encoding=replace(
        keyframe.encoding, frame=replace(frame, image=image))), at


def _found(keyframe: Keyframe, at: np.ndarray) -> np.ndarray:
    """[N] bool: of the places, which have a landmark whose patch holds the cross."""
    uv = matched_grid(24).of(keyframe).uv
    assert len(uv) == len(at), 'one for each square'
    near: np.ndarray = np.abs(uv - at).max(1) <= 5
    return near


def test_the_grid_takes_the_textured_point_of_each_square(clip: Clip) -> None:
    assert _found(*_dotted(clip)).all()


def test_the_grid_keeps_away_from_depth_edges(clip: Clip) -> None:
    """From the column of one of them on everything is 1.5 times as far."""
    keyframe, at = _dotted(clip)
    column = int(at[len(at) // 2, 0])
    points = keyframe.points_cam.clone()
    points[:, column:] *= 1.5
    keyframe = replace(keyframe, points_cam=points)
    assert _found(keyframe, at)[np.abs(at[:, 0] - column) > 9].all()
    assert (np.abs(matched_grid(24).of(keyframe).uv[:, 0] - (column - 0.5)) >= 4).all()


def test_the_grid_keeps_away_from_what_is_least_known(clip: Clip) -> None:
    """The right part, 14 per cent: squares on the border take a known pixel without texture."""
    keyframe, at = _dotted(clip)
    confidence = keyframe.confidence.clone()
    confidence[:, -45:] = 1.001
    keyframe = replace(keyframe, confidence=confidence)
    landmarks = matched_grid(24).of(keyframe)
    width = keyframe.frame.width
    limit, first = width - 45, width % SIDE // 2
    straddling = (at[:, 0] - first) // SIDE == (limit - first) // SIDE
    assert straddling.any() and (at[straddling, 0] >= limit).any()
    assert (landmarks.uv[straddling, 0] < limit).all()
    known = landmarks.seen().uv
    assert len(known) and (known[:, 0] < limit).all()


def test_landmarks_that_learnt_nothing_are_none(clip: Clip) -> None:
    keyframe = clips.true_map(clip, [10])[0]
    nothing = replace(keyframe, confidence=torch.full_like(keyframe.confidence, 1.0))
    assert len(matched_grid(24).of(nothing).seen().uv) == 0


def test_landmarks_are_corners_of_what_was_seen(clip: Clip) -> None:
    keyframe = clips.true_map(clip, [10])[0]
    confidence = keyframe.confidence.clone()
    confidence[:, :45] = 1.001     # 14 per cent; the worst fifth is left out
    landmarks = followed_corners(FollowingConfig()).of(replace(keyframe, confidence=confidence))
    assert 50 < len(landmarks.uv) <= FollowingConfig().points
    assert (landmarks.uv[:, 0] > 42).all() and landmarks.uv[:, 0].min() < 70
    assert len(landmarks.strongest(7).uv) == 7
    points = landmarks.points
    at = np.rint(landmarks.uv).astype(int)
    assert np.allclose(points[:, 2], keyframe.points_cam[at[:, 1], at[:, 0], 2].numpy())


def test_landmarks_stay_where_they_are_while_the_keyframe_learns(clip: Clip) -> None:
    keyframe, cache = clips.true_map(clip, [10])[0], followed_corners(FollowingConfig())
    first = cache.of(keyframe)
    moved = replace(keyframe, T_world_kf=2 * keyframe.T_world_kf)
    assert cache.of(moved) is first, 'a keyframe that only moved is not read again'
    grown = replace(keyframe, points_cam=keyframe.points_cam * 2,
                    confidence=keyframe.confidence + 1, observations=2)
    again = cache.of(grown)
    assert np.array_equal(again.uv, first.uv)
    assert np.allclose(again.points, 2 * first.points)
    assert torch.allclose(again.confidence, first.confidence + 1)


def test_sigma_of_a_depth_follows_its_confidence() -> None:
    confidence = torch.tensor([1.0, GUESSED_CONFIDENCE - 0.01, 2.0, 5.0, 500.0])
    sigma = relative_depth_sigma(confidence, 5.0, 0.03)
    assert float(sigma[3]) == pytest.approx(0.03)
    assert float(sigma[0]) == float(sigma[1]) == 0.5 > float(sigma[2]) > float(sigma[3])
    assert float(sigma[4]) >= 0.3 * 0.03, 'never sure beyond reason'
    # fused four times: the same ratios, the same sigmas
    assert torch.allclose(relative_depth_sigma(1 + 4 * (confidence[2:] - 1), 17.0, 0.03),
                          sigma[2:])
