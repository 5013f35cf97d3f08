"""Which keyframes an image is followed against."""

from __future__ import annotations

import clip as clips
import pytest
import torch
from clip import Clip

from aim_slam_ros.frontend.following import Followed, Follower
from aim_slam_ros.frontend.landmarks import followed_corners
from aim_slam_ros.frontend.references import References
from aim_slam_ros.types import Frame


def _references(clip: Clip, indices: list[int], main: int, units: tuple[float, ...] = (),
                **values: object) -> tuple[References, Follower]:
    config = clips.config(**values)
    follower = Follower(config.following, followed_corners(config.following))
    references = References(config, clips.true_map(clip, indices, units), follower)
    references.main_id = main
    return references, follower


def _reuse(clip: Clip, references: References, follower: Follower, index: int,
           ) -> tuple[Followed, Followed]:
    """How the image was followed at first, and after looking for an older reference."""
    frame: Frame = clip.frame(index)
    assert frame.K is not None
    T = clip.T_world_cam[index]
    before = follower.follow(frame.grey, frame.K, T, [references.main])
    return before, references.reuse(frame.grey, frame.K, before)


def test_the_reference_comes_first_then_the_nearest(clip: Clip) -> None:
    references, _ = _references(clip, [4, 8, 12, 16, 20], 1, following__references=3)
    assert [k.keyframe_id for k in references.near(clip.T_world_cam[17])] == [1, 3, 4]
    assert [k.keyframe_id for k in references.near(clip.T_world_cam[4])] == [1, 0, 2]
    assert references.main.keyframe_id == 1


@pytest.mark.parametrize('count', [1, 2, 9])
def test_there_are_as_many_as_wanted_and_known(clip: Clip, count: int) -> None:
    references, _ = _references(clip, [4, 8, 12], 0, following__references=count)
    assert len(references.near(clip.T_world_cam[4])) == min(count, 3)


def test_nearness_does_not_depend_on_units(clip: Clip) -> None:
    references, _ = _references(clip, [4, 8, 12, 16], 0, (1.0, 5.0, 0.2, 1.0))
    assert [k.keyframe_id for k in references.near(clip.T_world_cam[12])][1] == 2


def test_an_older_keyframe_that_sees_the_same_is_taken(clip: Clip) -> None:
    """The camera is back at keyframe 0 while keyframe 1 is still the reference."""
    references, follower = _references(clip, [10, 18], 1, keyframes__reuse_above=0.6)
    before, after = _reuse(clip, references, follower, 11)
    assert references.main_id == 0
    assert after.ok and after.matched_fraction > 0.6 > before.matched_fraction
    assert torch.allclose(after.T_world_cam, clip.T_world_cam[11], atol=0.02)


def test_none_is_taken_where_all_see_too_little(clip: Clip) -> None:
    references, follower = _references(clip, [10, 18], 1, keyframes__reuse_above=1.0)
    before, after = _reuse(clip, references, follower, 12)
    assert references.main_id == 1 and after is before


def test_a_reference_that_disappoints_is_given_back(clip: Clip) -> None:
    """It saw enough to be tried, but not enough to keep."""
    references, follower = _references(clip, [10, 18], 1, keyframes__reuse_above=0.6,
                                       keyframes__promote_below=0.95)
    before, after = _reuse(clip, references, follower, 12)
    assert references.main_id == 1 and after is before
