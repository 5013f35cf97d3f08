"""A pose for every image from the keyframes' points."""

from __future__ import annotations

import math
from dataclasses import replace

import clip as clips
import numpy as np
import pytest
import torch
from clip import Clip
from torch import Tensor

from aim_slam_ros.config import FollowingConfig
from aim_slam_ros.frontend.following import Followed, Follower
from aim_slam_ros.frontend.landmarks import followed_corners
from aim_slam_ros.geometry import sim3
from aim_slam_ros.types import Keyframe

CONFIG = FollowingConfig()


def _follow(clip: Clip, references: list[Keyframe], index: int, T_guess: Tensor,
            config: FollowingConfig = CONFIG) -> Followed:
    frame = clip.frame(index)
    assert frame.K is not None
    return Follower(config, followed_corners(config)).follow(
        frame.grey, frame.K, T_guess, references)


def _error(T: Tensor, truth: Tensor) -> tuple[float, float]:
    """Rotation [deg], position [m]."""
    return math.degrees(sim3.angle_rad(T, truth)), float((T - truth)[:3, 3].norm())


@pytest.mark.parametrize('unit', [1.0, 0.4, 7.0])
def test_the_pose_is_right_whatever_the_keyframes_unit(clip: Clip, unit: float) -> None:
    keyframe = clips.true_map(clip, [10], (unit,))[0]
    got = _follow(clip, [keyframe], 12, clip.T_world_cam[10])
    assert got.ok and got.reason == ''
    rotation, position = _error(got.T_world_cam, clip.T_world_cam[12])
    # half a pixel of noise over a hundred points at 2 to 3 m and f = 264 px
    assert rotation < 0.2 and position < 0.02
    assert float(sim3.scale_of(got.T_world_cam)) == pytest.approx(1.0, abs=1e-9)


def test_a_guess_far_away_is_searched_for(clip: Clip) -> None:
    """Ten degrees beside the truth, some 50 px."""
    keyframe = clips.true_map(clip, [10])[0]
    wrong = clip.T_world_cam[12] @ sim3.exp(torch.tensor([0., 0., 0., 0.05, 0.16, 0, 0]).double())
    got = _follow(clip, [keyframe], 12, wrong)
    assert got.ok and _error(got.T_world_cam, clip.T_world_cam[12])[1] < 0.02


def test_the_share_falls_as_the_camera_leaves(clip: Clip) -> None:
    keyframe = clips.true_map(clip, [10])[0]
    fractions = [_follow(clip, [keyframe], i, clip.T_world_cam[i]).matched_fraction
                 for i in (10, 14, 20)]
    assert 1.0 >= fractions[0] > 0.9
    assert fractions[0] > fractions[1] > fractions[2]


def test_every_reference_has_its_share(clip: Clip) -> None:
    keyframes = clips.true_map(clip, [10, 16, 4], (1.0, 2.0, 0.5))
    got = _follow(clip, [keyframes[1], keyframes[0], keyframes[2]], 17, clip.T_world_cam[16])
    assert list(got.fractions) == [1, 0, 2]
    assert got.matched_fraction == got.fractions[1] > got.fractions[0] > got.fractions[2]
    assert _error(got.T_world_cam, clip.T_world_cam[17])[1] < 0.02


def test_what_it_found_is_consistent(clip: Clip) -> None:
    """points_world projected by the pose are at uv."""
    keyframe = clips.true_map(clip, [10], (3.0,))[0]
    got = _follow(clip, [keyframe], 12, clip.T_world_cam[10])
    K = clip.frame(12).K
    assert K is not None
    P = sim3.transform(sim3.inverse(got.T_world_cam), torch.from_numpy(got.points_world))
    uv = (P[:, :2] / P[:, 2:] * K.diagonal()[:2] + K[:2, 2]).numpy()
    assert len(uv) > 50 and np.median(np.abs(uv - got.uv)) < 1.0


def test_another_place_is_no_pose(clip: Clip) -> None:
    keyframe = clips.true_map(clip, [10])[0]
    frame = clip.frame(10)
    grey = clips.noise(3, (frame.width, frame.height))[..., 0].copy()
    assert frame.K is not None
    got = Follower(CONFIG, followed_corners(CONFIG)).follow(
        grey, frame.K, clip.T_world_cam[10], [keyframe])
    assert not got.ok and 'points' in got.reason
    assert bool(torch.isfinite(got.T_world_cam).all()) and got.T_world_cam.shape == (4, 4)


def test_too_few_points_are_no_pose(clip: Clip) -> None:
    keyframe = clips.true_map(clip, [10])[0]
    got = _follow(clip, [keyframe], 11, clip.T_world_cam[10], replace(CONFIG, min_inliers=900))
    assert not got.ok and got.matched_fraction == 0.0 and 'only' in got.reason


def test_a_keyframe_without_corners_is_no_crash(clip: Clip) -> None:
    keyframe = clips.true_map(clip, [10])[0]
    frame = replace(keyframe.frame, image=np.full_like(keyframe.frame.image, 100))
    blank = replace(keyframe, encoding=replace(keyframe.encoding, frame=frame))
    assert not _follow(clip, [blank], 11, clip.T_world_cam[10]).ok


def test_half_of_a_wrong_map_is_outvoted(clip: Clip) -> None:
    """One of two references has a pose that is 30 cm off."""
    keyframes = clips.true_map(clip, [10, 12])
    moved = keyframes[1].T_world_kf.clone()
    moved[:3, 3] += 0.3
    wrong = replace(keyframes[1], T_world_kf=moved)
    strict = replace(CONFIG, min_inlier_ratio=0.3)
    got = _follow(clip, [keyframes[0], wrong], 11, clip.T_world_cam[10], strict)
    right = _follow(clip, [keyframes[0]], 11, clip.T_world_cam[10], strict)
    assert right.ok and _error(right.T_world_cam, clip.T_world_cam[11])[1] < 0.02
    assert not got.ok or min(got.fractions.values()) < 0.5 * max(got.fractions.values())


def test_what_drift_has_put_elsewhere_does_not_outvote_the_reference(clip: Clip) -> None:
    """Two old keyframes, a long way round behind the reference, 40 cm beside it: of one mind, but
    the image is followed from the reference."""
    keyframes = clips.true_map(clip, [4, 11, 13])
    drift = torch.tensor([0.4, 0.0, 0.0], dtype=torch.float64)
    drifted = []
    for keyframe in keyframes.piece[1:]:
        T_world_kf = keyframe.T_world_kf.clone()
        T_world_kf[:3, 3] += drift
        drifted.append(replace(keyframe, T_world_kf=T_world_kf))
    T_drifted = clip.T_world_cam[12].clone()
    T_drifted[:3, 3] += drift
    got = _follow(clip, [keyframes[0], *drifted], 12, T_drifted)
    # 4 cm: half of what the reference saw has left the image
    assert got.ok and _error(got.T_world_cam, clip.T_world_cam[12])[1] < 0.06
    without = _follow(clip, drifted, 12, T_drifted)
    assert without.ok and _error(without.T_world_cam, T_drifted)[1] < 0.03


def test_ten_per_cent_of_depth_noise_in_a_far_away_world(clip: Clip) -> None:
    """It is along the keyframe's rays, wherever the world's origin is."""
    keyframe = clips.true_map(clip, [10])[0]
    rng = torch.Generator().manual_seed(0)
    noise = torch.exp(0.1 * torch.randn(keyframe.points_cam.shape[:2], generator=rng))
    away = sim3.identity()
    away[:3, 3] = torch.tensor([30.0, -20.0, 10.0])
    noisy = replace(keyframe, points_cam=keyframe.points_cam * noise[..., None],
                    T_world_kf=away @ keyframe.T_world_kf)
    got = _follow(clip, [noisy], 12, away @ clip.T_world_cam[10],
                  replace(CONFIG, sigma_depth=0.1))
    rotation, position = _error(got.T_world_cam, away @ clip.T_world_cam[12])
    assert got.ok and got.matched_fraction > 0.6
    # noisy depths pull the camera towards the keyframe: 3 cm of the 17 cm between them
    assert rotation < 0.8 and position < 0.045
