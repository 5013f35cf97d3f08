"""A lost image found again."""

from __future__ import annotations

from dataclasses import replace

import clip as clips
import pytest
import torch
from clip import Clip

from aim_slam_ros.config import Config
from aim_slam_ros.frontend.following import Follower
from aim_slam_ros.frontend.image_tracking import ImageTracker
from aim_slam_ros.frontend.keyframe_map import KeyframeMap
from aim_slam_ros.frontend.landmarks import followed_corners
from aim_slam_ros.frontend.relocalisation import Relocalisation
from aim_slam_ros.frontend.stages import Stopwatch
from aim_slam_ros.frontend.window import WindowTracker
from aim_slam_ros.models import make_model
from aim_slam_ros.types import FrameEncoding

KEYFRAMES = [2, 10, 18, 26, 34]


def _parts(clip: Clip, config: Config) -> tuple[KeyframeMap, Relocalisation, WindowTracker]:
    """A true map whose encodings are the classical model's own."""
    model = make_model(config)
    keyframes = KeyframeMap(config.sigma)
    for index in KEYFRAMES:
        made = clips.add_keyframe(clips.true_map(clip, []), clip, index)
        keyframes.add(model.encode(made.frame), made.K, made.points_cam, made.confidence,
                      made.T_world_kf)
    follower = Follower(config.following, followed_corners(config.following))
    window = WindowTracker(config, model, ImageTracker(
        config.tracking, config.following, config.keyframes.min_confident))
    return keyframes, Relocalisation(config, keyframes, follower, window), window


def _encoded(clip: Clip, index: int, window: WindowTracker) -> FrameEncoding:
    return window.encode(clip.frame(index), Stopwatch())


@pytest.mark.parametrize('index', [3, 11, 19, 33])
def test_an_image_is_found_where_it_is(clip: Clip, index: int) -> None:
    _, relocalisation, window = _parts(clip, clips.config())
    encoding = _encoded(clip, index, window)
    assert encoding.frame.K is not None
    got = relocalisation.find(encoding, encoding.frame.K, Stopwatch())
    assert got is not None and got.ok
    assert torch.allclose(got.T_world_cam, clip.T_world_cam[index], atol=0.02)
    nearest = min(range(5), key=lambda k: abs(KEYFRAMES[k] - index))
    assert next(iter(got.fractions)) == nearest, 'its reference'


def test_an_image_of_elsewhere_is_not_found(clip: Clip) -> None:
    _, relocalisation, window = _parts(clip, clips.config())
    frame = clip.frame(3)
    strange = replace(frame, image=clips.noise(5, (frame.width, frame.height)))
    assert frame.K is not None
    encoding = window.encode(strange, Stopwatch())
    assert relocalisation.find(encoding, frame.K, Stopwatch()) is None


def test_what_is_seen_too_little_is_not_found(clip: Clip) -> None:
    config = clips.config(relocalisation__min_matched_fraction=1.0)
    _, relocalisation, window = _parts(clip, config)
    encoding = _encoded(clip, 14, window)
    assert encoding.frame.K is not None
    assert relocalisation.find(encoding, encoding.frame.K, Stopwatch()) is None


def test_where_following_fails_the_model_gives_the_guess(clip: Clip) -> None:
    """Turned by 26 degrees, some 130 px: too far for optical flow from the keyframe's pose."""
    _, relocalisation, window = _parts(clip, clips.config(
        relocalisation__min_matched_fraction=0.2))
    frame = clip.frame(20)
    assert frame.K is not None
    aside = clips.turned(frame.image, frame.K.numpy(), (0.0, -0.45, 0.0))
    encoding = window.encode(replace(frame, image=aside), Stopwatch())
    got = relocalisation.find(encoding, frame.K, Stopwatch())
    assert window.inferences == 1, 'or following found it and this test tests nothing'
    assert got is not None
    assert float((got.T_world_cam - clip.T_world_cam[20])[:3, 3].norm()) < 0.03


def test_an_empty_map_has_nothing_to_find(clip: Clip) -> None:
    keyframes, relocalisation, window = _parts(clip, clips.config())
    keyframes.begin_piece()
    encoding = _encoded(clip, 3, window)
    assert encoding.frame.K is not None
    assert relocalisation.find(encoding, encoding.frame.K, Stopwatch()) is None
