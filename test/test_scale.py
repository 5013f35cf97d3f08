"""The robust scale between two depths."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from aim_slam_ros.registration.scale import log_depth_ratio, weighted_median


def _depths(count: int, scale: float, sigma: float) -> tuple[Tensor, Tensor]:
    rng = torch.Generator().manual_seed(0)
    depth = 1.0 + 3.0 * torch.rand(count, generator=rng)
    return scale * depth * torch.exp(sigma * torch.randn(count, generator=rng)), depth


def test_a_third_of_outliers_barely_moves_it() -> None:
    a, b = _depths(1000, 0.4, 0.05)
    a[:333] *= 3.0
    got = log_depth_ratio(a, b, torch.ones(1000))
    # one-sided outliers shift a median to the 75 % quantile of the rest: .67 sigma
    assert abs(math.log(got.scale / 0.4)) < 0.05
    assert got.count == 1000


def test_spread_is_the_deviation_of_one_ratio() -> None:
    a, b = _depths(4000, 2.0, 0.1)
    got = log_depth_ratio(a, b, torch.ones(4000))
    assert got.spread == pytest.approx(0.1, rel=0.1)
    assert got.scale == pytest.approx(2.0, rel=0.01)
    few = log_depth_ratio(a[:100], b[:100], torch.ones(100))
    assert got.sigma < few.sigma < few.spread


def test_the_other_way_round_is_the_inverse() -> None:
    a, b = _depths(501, 0.7, 0.2)
    weights = torch.rand(501, generator=torch.Generator().manual_seed(1))
    there, back = log_depth_ratio(a, b, weights), log_depth_ratio(b, a, weights)
    assert there.scale * back.scale == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize('bad', [0.0, -1.0, math.nan, math.inf])
@pytest.mark.parametrize('side', [0, 1])
def test_what_is_no_depth_does_not_count(bad: float, side: int) -> None:
    depths = _depths(100, 1.5, 0.0)
    depths[side][:60] = bad
    got = log_depth_ratio(*depths, torch.ones(100))
    assert got.count == 40 and got.scale == pytest.approx(1.5, rel=1e-5)


def test_points_without_weight_do_not_count() -> None:
    a, b = _depths(100, 1.5, 0.0)
    a[:70] *= 9.0
    weights = torch.ones(100)
    weights[:70] = 0.0
    got = log_depth_ratio(a, b, weights)
    assert got.count == 30 and got.scale == pytest.approx(1.5, rel=1e-5)


def test_with_nothing_to_compare_there_is_no_scale() -> None:
    for count in (0, 5):
        got = log_depth_ratio(torch.zeros(count), torch.ones(count), torch.ones(count))
        assert got.count == 0 and math.isnan(got.scale) and got.sigma == math.inf


def test_weighted_median_is_where_half_the_weight_is_reached() -> None:
    values = np.array([5.0, 1.0, 3.0, 2.0])
    assert weighted_median(values, np.array([1.0, 1.0, 1.0, 10.0])) == 2.0
    assert weighted_median(values, np.array([10.0, 1.0, 1.0, 1.0])) == 5.0
    assert weighted_median(np.array([4.0]), np.array([0.1])) == 4.0
