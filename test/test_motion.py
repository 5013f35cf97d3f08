"""The prediction by constant velocity."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from aim_slam_ros.frontend.motion import ConstantVelocity
from aim_slam_ros.geometry import sim3

STEP_NS = 33_000_000
STEP = sim3.exp(torch.tensor([0.1, 0.0, 0.02, 0.0, 0.05, 0.01, 0.0], dtype=torch.float64))


def _moving(steps: int = 3) -> tuple[ConstantVelocity, Tensor]:
    motion, T = ConstantVelocity(), sim3.identity()
    for k in range(steps):
        motion.update(1000 + k * STEP_NS, T)
        last, T = T, T @ STEP
    return motion, last


def _next(motion: ConstantVelocity, steps: float, moving: int = 3) -> Tensor:
    return motion.predict(1000 + int((moving - 1 + steps) * STEP_NS))


def test_it_goes_on_as_before() -> None:
    motion, last = _moving()
    assert torch.allclose(_next(motion, 1), last @ STEP)
    assert torch.allclose(_next(motion, 2), last @ STEP @ STEP)
    assert torch.allclose(_next(motion, 0.5) @ sim3.inverse(last) @ _next(motion, 0.5),
                          last @ STEP, atol=1e-9)


def test_after_one_pose_and_after_a_stop_it_stands_still() -> None:
    motion, last = _moving(1)
    assert torch.equal(_next(motion, 1, 1), last)
    motion, last = _moving()
    motion.stop()
    assert torch.equal(_next(motion, 1), last)
    assert torch.equal(motion.T_world_cam, last)


def test_a_long_gap_says_nothing() -> None:
    motion, last = _moving()
    assert torch.equal(_next(motion, 30), last)
    # a few missing images: it moves on, but never far
    assert float((_next(motion, 4) - last)[:3, 3].norm()) <= 2.01 * float(STEP[:3, 3].norm())


def test_the_world_can_be_moved_under_it() -> None:
    """A correction scales and turns the world; the camera's own motion turns with it."""
    motion, last = _moving()
    T = sim3.from_parts(2.0, sim3.exp(torch.tensor([0., 0, 0, 0, 0, 1.2, 0]).double())[:3, :3],
                        torch.tensor([3.0, -1.0, 0.5]))
    motion.move_world(T)
    assert torch.allclose(motion.T_world_cam, sim3.rigid_part(T @ last))
    assert torch.allclose(_next(motion, 1), sim3.rigid_part(T @ last @ STEP), atol=1e-9)
    ConstantVelocity().move_world(T)    # nothing to move yet


def test_before_the_first_pose_there_is_no_prediction() -> None:
    with pytest.raises(LookupError, match='no image has been tracked'):
        ConstantVelocity().predict(5)
