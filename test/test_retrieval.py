"""Retrieval of loop candidates."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from aim_slam_ros.config import LoopClosureConfig
from aim_slam_ros.loop_closure.retrieval import Retrieval, RetrievalError


def around(angle: float, seed: int = 0) -> Tensor:
    """A descriptor of the view at this angle of a walk in a circle; 64 numbers."""
    rng = torch.Generator().manual_seed(seed)
    # Random Fourier features: cosine similarity falls off with the angle between two views.
    frequency = torch.randint(-6, 7, (64,), generator=rng)
    phase = 6.28 * torch.rand(64, generator=rng)
    return torch.cos(frequency * angle + phase)


def circle(views: int, step: float) -> Retrieval:
    retrieval = Retrieval(LoopClosureConfig(similarity=0.5))
    for k in range(views):
        retrieval.add(k, around(step * k))
    return retrieval


def test_a_revisited_place_is_found_best_first() -> None:
    retrieval = circle(60, 6.2832 / 50)     # keyframe 55 looks like keyframe 5
    found = retrieval.candidates(55, set(range(45, 60)))
    assert [c.keyframe_id for c in found][0] == 5
    assert len(found) == 2 and found[0].similarity >= found[1].similarity
    assert found[0].similarity == pytest.approx(1.0, abs=1e-3)


def test_nothing_is_found_where_nothing_was_revisited() -> None:
    retrieval = circle(30, 6.2832 / 50)
    assert retrieval.candidates(29, set(range(20, 30))) == ()


def test_the_neighbourhood_and_the_keyframe_itself_are_no_candidates() -> None:
    retrieval = circle(60, 6.2832 / 50)
    near = set(range(45, 60)) | set(range(0, 12))
    assert not {c.keyframe_id for c in retrieval.candidates(55, near)} & near


def test_alone_or_without_any_reference_there_is_no_candidate() -> None:
    retrieval = Retrieval(LoopClosureConfig())
    retrieval.add(0, around(0.0))
    assert retrieval.candidates(0, {0}) == ()
    retrieval.add(7, around(0.0))
    assert retrieval.candidates(7, {7}) == ()


def test_the_first_keyframe_of_a_piece_is_judged_by_what_was_usual_before() -> None:
    retrieval = circle(40, 6.2832 / 50)
    retrieval.candidates(39, set(range(30, 40)))
    retrieval.add(40, around(6.2832 / 50 * 12))
    assert retrieval.candidates(40, {40})[0].keyframe_id == 12


def test_nothing_passes_where_all_views_look_alike() -> None:
    retrieval = Retrieval(LoopClosureConfig())
    for k in range(30):
        retrieval.add(k, torch.ones(8))
    assert retrieval.candidates(29, set(range(20, 30))) == ()


def test_ids_need_not_be_dense_and_storage_grows() -> None:
    retrieval = Retrieval(LoopClosureConfig())
    for k in range(300):
        retrieval.add(10 * k, around(6.2832 / 250 * k))
    near = {10 * k for k in range(250, 300)}
    assert len(retrieval) == 300
    assert retrieval.candidates(2990, near)[0].keyframe_id == 490


def test_lengths_do_not_matter() -> None:
    retrieval = Retrieval(LoopClosureConfig())
    for k in range(60):
        retrieval.add(k, (1 + k) * around(6.2832 / 50 * k))
    assert retrieval.candidates(55, set(range(45, 60)))[0].similarity <= 1.0 + 1e-5


@pytest.mark.parametrize('bad', [torch.ones(5), torch.ones(2, 32), torch.full((64,), torch.nan)])
def test_a_descriptor_of_another_kind_is_refused(bad: Tensor) -> None:
    retrieval = circle(3, 0.1)
    with pytest.raises(RetrievalError, match='same geometry model'):
        retrieval.add(3, bad)
