"""VGGT's network: the official numbers, and what may be left out without changing them."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor, nn
from vggt_tiny import GRID, HEIGHT, WIDTH, fixture_path, images

from aim_slam_ros.models.vggt import parity, pose_encoding
from aim_slam_ros.models.vggt.aggregator import Grid
from aim_slam_ros.models.vggt.loading import empty_network, load_vggt
from aim_slam_ros.models.vggt.network import Vggt, VggtOutput
from aim_slam_ros.models.vggt.rope import rotated, view_turns
from aim_slam_ros.models.vggt.sizes import SizesError, VggtSizes
from aim_slam_ros.models.vggt.synthetic import TINY, random_network

PARITY = 1e-5       # the bound; measured 5e-7
ROUNDING = 2e-6     # float32, the same sums in another order


@pytest.fixture(scope='module')
def network() -> Vggt:
    return random_network(TINY)


def _output(network: Vggt, views: int = 3) -> VggtOutput:
    return network(parity.begun(network, network.encode(images(views)), GRID), GRID)


class TestParity:
    def test_every_recorded_array_is_matched(self) -> None:
        """Also with views prepared one by one, as the cache does, and in another order."""
        differences = parity.compare(fixture_path('tiny'))
        assert {'patch_tokens', 'tokens_0', 'pose_enc_iter0', 'pose_enc_iter3', 'pose_enc',
                'extrinsic', 'intrinsic', 'depth', 'depth_conf', 'points'} <= differences.keys()
        assert max(differences.values()) < PARITY, differences

    def test_names_and_shapes_are_those_of_the_official_checkpoint(self) -> None:
        table = fixture_path('vggt_1b_state_dict.tsv').read_text(encoding='utf-8')
        rows = [line.split('\t') for line in table.splitlines()]
        wanted = {name: shape for name, shape in rows
                  if not name.startswith(('point_head.', 'track_head.'))}
        ours = {name: str(tuple(tensor.shape))
                for name, tensor in empty_network(VggtSizes()).state_dict().items()}
        assert ours == wanted


class TestSavings:
    """What is left out changes nothing."""

    @pytest.mark.parametrize('views', [(0,), (2,), (2, 0), (0, 1, 2)])
    def test_depth_of_some_views_only(self, network: Vggt, views: tuple[int, ...]) -> None:
        tokens = parity.begun(network, network.encode(images()), GRID)
        whole, part = network(tokens, GRID), network(tokens, GRID, depth_views=views)
        assert part.depth.shape == (len(views), HEIGHT, WIDTH)
        assert parity.difference(part.depth, whole.depth[list(views)]) < ROUNDING
        assert parity.difference(part.confidence, whole.confidence[list(views)]) < ROUNDING
        for ours, theirs in zip(part.pose_rounds, whole.pose_rounds):
            assert parity.difference(ours, theirs) < ROUNDING

    def test_no_depth_at_all(self, network: Vggt) -> None:
        tokens = parity.begun(network, network.encode(images()), GRID)
        output = network(tokens, GRID, depth_views=())
        assert output.depth.shape == (0, HEIGHT, WIDTH) and not output.layers
        assert parity.difference(output.pose_rounds[-1],
                                 network(tokens, GRID).pose_rounds[-1]) < ROUNDING

    def test_a_head_that_does_not_read_the_last_layer(self) -> None:
        """Then the last global block is needed for the camera tokens alone."""
        network = random_network(VggtSizes(**{**vars(TINY), 'dpt_layers': (0, 1, 1, 2)}))
        tokens = parity.begun(network, network.encode(images()), GRID)
        whole = network(tokens, GRID, keep=(3,))
        assert parity.difference(network(tokens, GRID).pose_rounds[-1],
                                 whole.pose_rounds[-1]) < ROUNDING

    def test_another_image_size_in_between(self, network: Vggt) -> None:
        """Tables are kept for each size."""
        before = _output(network)
        wide = torch.rand(2, 3, 42, 140)
        grid = Grid(3, 10)
        network(parity.begun(network, network.encode(wide), grid), grid)
        assert torch.equal(before.depth, _output(network).depth)


def test_no_value_of_a_tensor_is_looked_at() -> None:
    """At full size on the meta device, which has none: nothing in it can wait for a GPU."""
    network = empty_network(VggtSizes())
    patches = network.encode(torch.empty(5, 3, 392, 518, device='meta'))
    grid = Grid(28, 37)
    output = network(parity.begun(network, patches, grid), grid, depth_views=(0, 1))
    assert output.depth.shape == output.confidence.shape == (2, 392, 518)
    assert output.pose_rounds[-1].shape == (5, 9)
    # kept: 4 layers of 2 views of 1041 tokens, and no others
    assert {tuple(tokens.shape) for tokens in output.layers.values()} == {(2, 1041, 2048)}
    assert sorted(output.layers) == [4, 11, 17, 23]


class TestPrecision:
    def test_bfloat16_is_near_float32(self, network: Vggt) -> None:
        """bfloat16 rounds by up to .4 %; sums of a few roundings, measured .1 to .4 %."""
        fast = random_network(TINY)
        fast.set_transformer_dtype(torch.bfloat16)
        exact, near = _output(network), _output(fast)
        for a, b in ((near.depth, exact.depth), (near.confidence, exact.confidence),
                     (near.pose_rounds[-1], exact.pose_rounds[-1])):
            assert a.dtype == torch.float32
            assert 1e-6 < parity.difference(a, b) < 0.015

    def test_the_official_weights_in_bfloat16_are_near_float32(self) -> None:
        folder = fixture_path('tiny')
        exact, near = (_output(load_vggt(folder, dtype=dtype))
                       for dtype in (torch.float32, torch.bfloat16))
        assert parity.difference(near.depth, exact.depth) < 0.015
        assert parity.difference(near.pose_rounds[-1], exact.pose_rounds[-1]) < 0.015

    @pytest.mark.parametrize('autocast', [False, True])
    def test_heads_run_in_float32(self, autocast: bool) -> None:
        """Whatever the transformer runs in, and even where the caller asks for autocast."""
        network = random_network(TINY)
        network.set_transformer_dtype(torch.bfloat16)
        seen: dict[str, set[torch.dtype]] = {'aggregator': set(), 'heads': set()}

        def watch(part: str) -> object:
            return lambda module, args, out: seen[part].update({out.dtype, module.weight.dtype})
        for name, module in network.named_modules():
            if isinstance(module, (nn.Linear, nn.Conv2d, nn.ConvTranspose2d)):
                part = 'aggregator' if name.startswith('aggregator') else 'heads'
                module.register_forward_hook(watch(part))   # type: ignore[arg-type]
        with torch.autocast('cpu', torch.bfloat16, enabled=autocast):
            _output(network)
        assert seen == {'aggregator': {torch.bfloat16}, 'heads': {torch.float32}}

    def test_compiled_blocks_give_the_same(self, network: Vggt) -> None:
        """Traced and run as they are: what a real backend does with them is torch's matter."""
        compiled = random_network(TINY)
        compiled.compile_blocks(backend='eager')
        for views in (1, 3, 2):
            assert parity.difference(_output(compiled, views).depth,
                                     _output(network, views).depth) < ROUNDING


def test_rotations_depend_on_the_offset_alone() -> None:
    """What a query at p gives for a key at p + d is the same for every p."""
    q, k = torch.randn(2, 1, 16, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    turns = view_turns(5, 6, 0, 16, 'cpu').double()
    scores = rotated(q, turns) @ rotated(k, turns).T                # [30,30]
    grid = scores.reshape(5, 6, 5, 6)
    # tables are float32
    assert grid[0, 1, 2, 0] == pytest.approx(float(grid[2, 5, 4, 4]), abs=1e-5)
    assert abs(float(grid[0, 1, 2, 0] - grid[0, 1, 0, 2])) > 1e-3
    assert torch.equal(rotated(q.float(), view_turns(1, 1, 1, 16, 'cpu')[:, :1]), q.float())


class TestPoseEncoding:
    def test_a_quaternion_of_any_length_is_a_rotation(self) -> None:
        encoding = torch.randn(20, 9, generator=torch.Generator().manual_seed(0)).double()
        T = pose_encoding.extrinsics(encoding)
        R = T[:, :3, :3]
        assert torch.allclose(R @ R.mT, torch.eye(3).double().expand(20, 3, 3), atol=1e-12)
        assert torch.allclose(torch.linalg.det(R), torch.ones(20).double())
        assert torch.equal(T[:, :3, 3], encoding[:, :3])

    def test_order_is_x_y_z_w(self) -> None:
        """A quarter turn about z takes x to y."""
        half = math.sqrt(0.5)
        encoding = torch.tensor([[0, 0, 0, 0, 0, half, half, 1, 1]]).double()
        turned = pose_encoding.extrinsics(encoding)[0, :3, :3] @ torch.eye(3).double()[0]
        assert torch.allclose(turned, torch.tensor([0.0, 1.0, 0.0]).double(), atol=1e-12)

    def test_fields_of_view_are_vertical_first(self) -> None:
        encoding: Tensor = torch.zeros(1, 9).double()
        encoding[0, 7:] = torch.tensor([math.pi / 2, 2 * math.atan(0.5)])
        K = pose_encoding.intrinsics(encoding, 392, 518)[0]
        assert K[1, 1] == pytest.approx(196) and K[0, 0] == pytest.approx(518)
        assert K[:2, 2].tolist() == [259, 196] and K[2].tolist() == [0, 0, 1]


@pytest.mark.parametrize('wrong', [{'image_size': 100}, {'dim': 60}, {'dpt_layers': (0, 1, 2, 4)}])
def test_sizes_that_cannot_be_are_refused(wrong: dict[str, int]) -> None:
    with pytest.raises(SizesError):
        VggtSizes(**{**vars(TINY), **wrong})
