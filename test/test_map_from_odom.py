"""Where odom lies in the map, also where the two have different units."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from aim_slam_ros.geometry import sim3
from aim_slam_ros.loop_closure.map_from_odom import MapFromOdom

T_MAP_ODOM = sim3.exp(torch.tensor([2.0, -1.0, 0.5, 0.3, -0.2, 0.4, 0.6]).double())
T_ODOM_KF = sim3.exp(torch.tensor([0.4, 0.1, 0.2, 0.1, 0.5, 0.0, -0.3]).double())
T_WORLD_KF = T_MAP_ODOM @ T_ODOM_KF


def along(step: float) -> Tensor:
    """A camera in its keyframe, in the keyframe's unit."""
    return sim3.exp(torch.tensor([0.3 * step, 0.1, 0.05 * step, 0.0, 0.1 * step, 0.0, 0.0]
                                 ).double())


def learn(place: MapFromOdom, T_kf_cam: Tensor, reference_id: int = 0) -> Tensor:
    return place.learn(reference_id, T_WORLD_KF, T_kf_cam,
                       sim3.rigid_part(T_ODOM_KF @ T_kf_cam).float().double())


def test_before_anything_is_known_odom_is_the_map() -> None:
    T = sim3.rigid_part(T_ODOM_KF)
    assert torch.allclose(MapFromOdom().place(T), T)


def test_a_frame_with_a_known_keyframe_is_where_that_puts_it() -> None:
    T = learn(MapFromOdom(), along(1.0))
    assert torch.allclose(T, sim3.rigid_part(T_WORLD_KF @ along(1.0)))
    assert float(sim3.scale_of(T)) == pytest.approx(1.0)


@pytest.mark.parametrize('reference_id', [0, 1])
def test_the_next_frame_is_placed_by_what_was_learned(reference_id: int) -> None:
    """Both units are known once the camera has moved; a change of reference keeps them."""
    place = MapFromOdom()
    learn(place, along(0.0))
    learn(place, along(1.0))
    learn(place, along(1.1), reference_id)
    T = place.place(sim3.rigid_part(T_ODOM_KF @ along(2.0)))
    # odom comes as float32
    assert torch.allclose(T, sim3.rigid_part(T_WORLD_KF @ along(2.0)), atol=1e-5)


def test_a_camera_that_stands_still_says_nothing_about_units() -> None:
    place = MapFromOdom()
    for _ in range(3):
        learn(place, along(1.0))
    T = place.place(sim3.rigid_part(T_ODOM_KF @ along(1.0)))
    assert torch.allclose(T, sim3.rigid_part(T_WORLD_KF @ along(1.0)), atol=1e-5)
