"""The keyframes and who sees what."""

from __future__ import annotations

from dataclasses import replace

import box_room
import pytest
import torch
from torch import Tensor

from aim_slam_ros.config import SigmaConfig
from aim_slam_ros.frontend.keyframe_map import KeyframeMap
from aim_slam_ros.geometry import sim3
from aim_slam_ros.types import CorrectedKeyframes, FrameEncoding, Keyframe, KeyframePose

CONFIG = SigmaConfig()


def _add(keyframes: KeyframeMap, T_world_cam: Tensor, descriptor: int = 0,
         unit: float = 1.0) -> Keyframe:
    made = box_room.keyframe(0, T_world_cam, unit)
    encoding = FrameEncoding(made.frame, torch.eye(8)[descriptor], None)
    return keyframes.add(encoding, made.K, made.points_cam, made.confidence, made.T_world_kf)


def _walk(count: int = 4) -> KeyframeMap:
    keyframes = KeyframeMap(CONFIG)
    for k, T in enumerate(box_room.trajectory(count)):
        _add(keyframes, T, k, 0.7 + 0.2 * k)
    return keyframes


def _behind() -> Tensor:
    """Looks at the opposite wall."""
    return box_room.pose((0.0, 0.0, 0.0), (0.0, 3.14159, 0.0))


def _correction(*poses: tuple[int, Tensor]) -> CorrectedKeyframes:
    return CorrectedKeyframes(1, tuple(KeyframePose(i, T) for i, T in poses))


MOVE = sim3.exp(torch.tensor([0.5, 0.1, -0.2, 0.0, 0.3, 0.1, 0.2], dtype=torch.float64))


def test_ids_count_up_and_are_never_used_again() -> None:
    keyframes = _walk(3)
    keyframes.begin_piece()
    fourth = _add(keyframes, box_room.trajectory(1)[0])
    assert [k.keyframe_id for k in keyframes.all] == [0, 1, 2, 3]
    assert (fourth.piece_id, keyframes.piece_id, keyframes[1].piece_id) == (1, 1, 0)
    assert keyframes.piece == (fourth,) and keyframes.piece[-1] is fourth


def test_covisible_are_those_that_share_space() -> None:
    keyframes = _walk(4)
    turned = _add(keyframes, _behind())
    assert {k.keyframe_id for k in keyframes.overlapping(0)} == {1, 2, 3}
    assert keyframes.overlapping(0)[0].keyframe_id == 1, 'the nearest shares most'
    assert keyframes.overlapping(turned.keyframe_id) == ()


def test_pieces_do_not_see_each_other() -> None:
    keyframes = _walk(2)
    assert KeyframeMap(CONFIG).similar(torch.eye(8)[0], 3) == []
    keyframes.begin_piece()
    assert keyframes.piece == () and keyframes.similar(torch.eye(8)[0], 3) == []
    assert keyframes.overlapping(0) == ()
    new = _add(keyframes, box_room.trajectory(1)[0], 5)
    assert keyframes.overlapping(new.keyframe_id) == ()
    assert keyframes.similar(torch.eye(8)[0], 3) == [new]


def test_similar_comes_best_first() -> None:
    keyframes = _walk(4)
    query = torch.tensor([0.1, 0.3, 0.9, 0.2, 0, 0, 0, 0])
    assert [k.keyframe_id for k in keyframes.similar(query, 3)] == [2, 1, 3]
    assert len(keyframes.similar(query, 99)) == 4


def test_fuse_replaces_the_pointmap() -> None:
    keyframes = _walk(2)
    grown = replace(keyframes[1], observations=5)
    keyframes.fuse(grown)
    assert keyframes[1] is grown and keyframes.piece[1] is grown
    assert keyframes.take_moved(0) == ()


def test_what_moved_is_told_once() -> None:
    keyframes = _walk(4)
    for i in (0, 2):
        keyframes.move([KeyframePose(i, MOVE @ keyframes[i].T_world_kf)])
    told = keyframes.take_moved(except_id=0)
    assert [p.keyframe_id for p in told] == [2]
    assert torch.equal(told[0].T_world_kf, keyframes[2].T_world_kf)
    assert keyframes.take_moved(except_id=0) == ()


def test_a_moved_keyframe_is_found_where_it_is_now() -> None:
    keyframes = _walk(2)
    away = keyframes[1].T_world_kf.clone()
    away[0, 3] += 50.0
    keyframes.move([KeyframePose(1, away)])
    assert keyframes.overlapping(0) == ()
    keyframes.move([KeyframePose(1, keyframes[0].T_world_kf)])
    assert [k.keyframe_id for k in keyframes.overlapping(0)] == [1]


def test_many_small_moves_are_one_large_one() -> None:
    keyframes = _walk(2)
    for _ in range(200):
        T = keyframes[1].T_world_kf.clone()
        T[0, 3] += 0.03     # of some 4 m of depth: none of these steps alone counts
        keyframes.move([KeyframePose(1, T)])
    assert keyframes.overlapping(0) == (), 'it is 6 m away, past the wall'


def test_newer_keyframes_move_along_with_a_correction() -> None:
    """It knows 0 to 2: what stands between 2 and 3 stays, also in scale."""
    keyframes = _walk(4)
    before = [k.T_world_kf for k in keyframes.all]
    small = sim3.exp(0.1 * sim3.log(MOVE))
    keyframes.correct(_correction((0, before[0]), (1, small @ before[1]), (2, MOVE @ before[2])))
    assert torch.equal(keyframes[0].T_world_kf, before[0])
    assert torch.allclose(keyframes[1].T_world_kf, small @ before[1])
    between = [sim3.inverse(a) @ b for a, b in ((before[2], before[3]),
                                                (keyframes[2].T_world_kf,
                                                 keyframes[3].T_world_kf))]
    assert torch.allclose(between[0], between[1])
    assert {k.keyframe_id for k in keyframes.all} == {0, 1, 2, 3}


def test_keyframes_that_a_correction_has_not_connected_stay_beside_the_others() -> None:
    """An event was lost: loop closure has 1 and 3 in pieces of their own, and joined 3 to 0's."""
    keyframes = _walk(1)
    keyframes.begin_piece()
    for k, T in enumerate(box_room.trajectory(4)[1:]):
        _add(keyframes, T, 4 + k)
    before = [k.T_world_kf for k in keyframes.all]
    keyframes.correct(CorrectedKeyframes(
        1, (KeyframePose(0, before[0]), KeyframePose(1, before[1]),
            KeyframePose(3, MOVE @ before[3])), {0: 0, 1: 1, 3: 0}))
    assert [k.piece_id for k in keyframes.all] == [0, 0, 0, 0]
    for i in (1, 2, 3):
        assert torch.allclose(keyframes[i].T_world_kf, MOVE @ before[i])
    assert {k.keyframe_id for k in keyframes.overlapping(1)} >= {2, 3}


@pytest.mark.parametrize('known', [(), (77,)])
def test_a_correction_of_nothing_known_changes_nothing(known: tuple[int, ...]) -> None:
    keyframes = _walk(2)
    before = keyframes.all
    keyframes.correct(_correction(*((i, MOVE) for i in known)))
    assert keyframes.all == before


def test_a_correction_of_another_piece_leaves_this_one() -> None:
    keyframes = _walk(2)
    keyframes.begin_piece()
    new = _add(keyframes, box_room.trajectory(1)[0])
    keyframes.correct(_correction((0, keyframes[0].T_world_kf),
                                  (1, MOVE @ keyframes[1].T_world_kf)))
    assert torch.equal(keyframes[new.keyframe_id].T_world_kf, new.T_world_kf)
    keyframes.correct(_correction((new.keyframe_id, MOVE)))
    assert torch.equal(keyframes[new.keyframe_id].T_world_kf, MOVE)


def test_a_loop_between_pieces_makes_them_one() -> None:
    """The older piece is overlapped and searched again from the newer, in the older's unit."""
    keyframes = _walk(3)
    keyframes.begin_piece()
    T_old_new = sim3.exp(torch.tensor([1.0, 0.0, 0.5, 0.0, 0.2, 0.0, 1.1], dtype=torch.float64))
    true = [k.T_world_kf for k in keyframes.all]
    for k, T in enumerate(box_room.trajectory(3)[1:]):
        again = _add(keyframes, T, 4 + k, 0.9 + 0.2 * k)
        keyframes.move([KeyframePose(again.keyframe_id, sim3.inverse(T_old_new) @ true[k + 1])])
    joined = CorrectedKeyframes(
        1, tuple(KeyframePose(i, T) for i, T in enumerate([*true, *true[1:]])),
        {i: 0 for i in range(5)})
    keyframes.correct(joined)
    assert keyframes.piece_id == 0 and len(keyframes.piece) == 5
    assert {1, 2} < {k.keyframe_id for k in keyframes.overlapping(3)}
    later = _add(keyframes, box_room.trajectory(3)[2], 7)
    assert later.piece_id == 0
    keyframes.begin_piece()
    assert keyframes.piece_id == 2, 'the number of a joined piece is not used again'
