"""Products by way of a convolution are the same products."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F

from aim_slam_ros.models.vggt import products
from aim_slam_ros.models.vggt.layers import Mlp

ROUNDING = 2e-6     # float32, the same sums in another order


@pytest.mark.parametrize('shape', [(1, 64), (127, 64), (128, 64), (2, 300, 64), (1, 9, 31, 64)])
@pytest.mark.parametrize('biased', [True, False])
def test_both_ways_agree(shape: tuple[int, ...], biased: bool,
                         monkeypatch: pytest.MonkeyPatch) -> None:
    generator = torch.Generator().manual_seed(0)
    x, weight = torch.randn(shape, generator=generator), torch.randn(96, 64, generator=generator)
    bias = torch.randn(96, generator=generator) if biased else None
    expected = F.linear(x.double(), weight.double(), None if bias is None else bias.double())
    for by_convolution in (True, False):
        monkeypatch.setattr(products, '_BY_CONVOLUTION', by_convolution)
        out = products.linear(x, weight, bias)
        assert out.shape == expected.shape and out.is_contiguous()
        assert float((out - expected).abs().max() / expected.abs().max()) < ROUNDING


# Too few to pay, one portion, two, and more keys than queries.
@pytest.mark.parametrize('rows, tokens', [(5, 5), (300, 300), (641, 641), (130, 1400)])
def test_attention_both_ways(rows: int, tokens: int, monkeypatch: pytest.MonkeyPatch) -> None:
    generator = torch.Generator().manual_seed(0)
    q = 3.0 * torch.randn(2, rows, 3, 16, generator=generator)
    k, v = torch.randn(2, 2, tokens, 3, 16, generator=generator)
    scores = torch.einsum('brhd,bthd->bhrt', q.double(), k.double()) / 4.0
    expected = torch.einsum('bhrt,bthd->brhd', scores.softmax(-1), v.double())
    for by_convolution in (True, False):
        monkeypatch.setattr(products, '_BY_CONVOLUTION', by_convolution)
        out = products.attention(q, k, v)
        assert out.shape == expected.shape
        assert float((out - expected).abs().max() / expected.abs().max()) < ROUNDING


def test_a_pixel_is_a_token() -> None:
    layer = products.PixelLinear(64, 32).requires_grad_(False)
    x = torch.randn(2, 64, 12, 17, generator=torch.Generator().manual_seed(0))
    expected = F.conv2d(x, layer.weight, layer.bias)
    assert torch.allclose(layer(x), expected, atol=ROUNDING * float(expected.abs().max()))


@pytest.mark.parametrize('shape', [(3, 1041, 8), (1, 2201, 8), (1, 5, 8)])
def test_an_mlp_in_portions_is_the_mlp(shape: tuple[int, ...]) -> None:
    mlp = Mlp(8, 32, 6).requires_grad_(False)
    x = torch.randn(shape, generator=torch.Generator().manual_seed(0))
    expected = mlp._portion(x)
    assert torch.allclose(mlp(x), expected, atol=ROUNDING * float(expected.abs().max()))
