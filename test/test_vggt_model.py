"""VGGT behind the geometry model's two calls."""

from __future__ import annotations

import gc
import logging
from pathlib import Path
from typing import Any

import pytest
import torch
from clip import Clip
from torch import Tensor
from vggt_tiny import HEIGHT, WIDTH, fixture_path, frame, write_checkpoint

from aim_slam_ros.config import Config, ConfigError
from aim_slam_ros.devices import chosen_device
from aim_slam_ros.frontend.pipeline import FrontendPipeline
from aim_slam_ros.geometry import camera, sim3
from aim_slam_ros.models import make_model
from aim_slam_ros.models.vggt import making, parity
from aim_slam_ros.models.vggt.model import VggtModel
from aim_slam_ros.models.vggt.network import Vggt, VggtOutput
from aim_slam_ros.models.vggt.synthetic import TINY, random_network
from aim_slam_ros.types import FrameEncoding, TrackingStatus, WindowPrediction

ROUNDING = 2e-6     # float32, the same sums in another order


def _model(network: Vggt | None = None, cached_frames: int = 16) -> VggtModel:
    return VggtModel(network or random_network(TINY), cached_frames, fov_deg=60.0)


def _encodings(model: VggtModel, views: int = 3) -> list[FrameEncoding]:
    return [model.encode(frame(seed)) for seed in range(views)]


def _same(a: WindowPrediction, b: WindowPrediction) -> bool:
    return all(parity.difference(x, y) < ROUNDING for x, y in (
        (a.depth, b.depth), (a.confidence, b.confidence), (a.K, b.K),
        (a.T_first_cam, b.T_first_cam)))


class TestContract:
    @pytest.mark.parametrize('views', [1, 2, 5])
    def test_what_it_predicts(self, views: int) -> None:
        model = _model()
        prediction = model.infer(_encodings(model, views))
        assert prediction.depth.shape == prediction.confidence.shape == (views, HEIGHT, WIDTH)
        assert prediction.depth.dtype == prediction.confidence.dtype == torch.float32
        assert bool((prediction.depth > 0).all()) and bool((prediction.confidence > 1).all())
        assert prediction.K.shape == (views, 3, 3) and prediction.K.dtype == torch.float64
        assert prediction.K[:, :2, 2].tolist() == [[WIDTH / 2, HEIGHT / 2]] * views
        T = prediction.T_first_cam
        assert T.dtype == torch.float64 and torch.equal(T[0], sim3.identity())
        assert torch.allclose(torch.linalg.det(T[:, :3, :3]), torch.ones(views).double())
        assert not prediction.rotation_only

    def test_the_descriptor(self) -> None:
        """One per image, of unit length, and of the image rather than of its place in a window."""
        model = _model()
        first, again, other = (model.encode(frame(seed)).descriptor for seed in (0, 0, 1))
        assert first.shape == (TINY.dim,) and first.dtype == torch.float32
        assert float(first.norm()) == pytest.approx(1.0, abs=1e-6)
        assert torch.equal(first, again) and float(first @ other) < 1.0

    def test_poses_are_anchored_at_the_first_view(self) -> None:
        """The network's own first pose is not the identity; relative poses are kept."""
        model = _model()
        encodings = _encodings(model)
        tokens = [e.features.begun(model._network, i == 0) for i, e in enumerate(encodings)]
        raw = model._network(torch.stack(tokens), encodings[0].features.grid).pose_rounds[-1]
        T_cam_world = parity.pose_encoding.extrinsics(raw.double())
        assert float((T_cam_world[0] - sim3.identity()).abs().max()) > 0.1
        T = model.infer(encodings).T_first_cam
        for i in (1, 2):
            assert torch.allclose(T[i] @ T_cam_world[i], T_cam_world[0], atol=1e-9)

    def test_a_calibrated_camera_keeps_its_own_intrinsics(self) -> None:
        model, K = _model(), camera.intrinsics(95.0, 94.0, 55.0, 43.0)
        prediction = model.infer([model.encode(frame(0, K)), model.encode(frame(1))])
        assert torch.equal(prediction.K[0], K) and not torch.equal(prediction.K[1], K)

    def test_windows_that_cannot_be(self) -> None:
        model = _model()
        with pytest.raises(ValueError, match='at least one view'):
            model.infer([])
        with pytest.raises(ValueError, match='same size'):
            model.infer([model.encode(frame(0)), model.encode(frame(1, size=(70, WIDTH)))])
        with pytest.raises(ValueError, match='multiples of 14'):
            model.encode(frame(0, size=(85, WIDTH)))


class TestCache:
    def test_an_image_is_prepared_once(self) -> None:
        """Patch tokens once; the first frame block once for each role."""
        network = random_network(TINY)
        count = {'patches': 0, 'first block': 0}

        def counted(what: str) -> Any:
            return lambda module, args, out: count.update({what: count[what] + len(out)})
        network.aggregator.patch_embed.register_forward_hook(counted('patches'))
        network.aggregator.frame_blocks[0].register_forward_hook(counted('first block'))
        model = _model(network)
        a, b, c = _encodings(model)
        model.infer([a, b])
        model.infer([a, b, c])
        assert count == {'patches': 3, 'first block': 3}
        model.infer([c, b, a])      # two change roles
        assert count == {'patches': 3, 'first block': 5}

    def test_cached_or_not_the_answer_is_the_same(self) -> None:
        model, forgetful = _model(), _model(cached_frames=1)
        encodings, fleeting = _encodings(model), _encodings(forgetful)
        assert fleeting[0].features.empty and not fleeting[2].features.empty
        model.infer(encodings[1:])
        assert _same(model.infer(encodings), forgetful.infer(fleeting))

    def test_the_order_of_the_keyframes_does_not_matter(self) -> None:
        model = _model()
        a, b, c = _encodings(model)
        there, back = model.infer([a, b, c]), model.infer([a, c, b])
        for x, y in ((there.depth, back.depth), (there.T_first_cam, back.T_first_cam)):
            assert parity.difference(x[[0, 2, 1]], y) < ROUNDING

    def test_tokens_go_with_their_keyframe(self) -> None:
        model = _model()
        encodings = _encodings(model)
        assert len(model._cache) == 3
        del encodings[0]
        gc.collect()
        assert len(model._cache) == 2

    def test_the_cache_is_bounded(self) -> None:
        model = _model(cached_frames=2)
        encodings = _encodings(model, 4)
        assert [e.features.empty for e in encodings] == [True, True, False, False]
        model.infer([encodings[0]])
        assert [e.features.empty for e in encodings] == [False, True, True, False]

    def test_depth_of_the_newest_only(self) -> None:
        """The others know nothing; poses and cameras are those of the whole."""
        model = _model()
        encodings = _encodings(model)
        whole, part = model.infer(encodings), model.infer(encodings, depth_views=(0,))
        assert parity.difference(part.depth[0], whole.depth[0]) < ROUNDING
        assert parity.difference(part.T_first_cam, whole.T_first_cam) < ROUNDING
        assert [part.seen_share(view) for view in range(3)] == [whole.seen_share(0), 0, 0]


class TestNonsense:
    """A network that sees nothing sensible gives finite numbers without confidence."""

    def _check(self, network: Vggt) -> WindowPrediction:
        model = _model(network)
        prediction = model.infer(_encodings(model))
        for tensor in (prediction.depth, prediction.confidence, prediction.K,
                       prediction.T_first_cam):
            assert bool(tensor.isfinite().all())
        assert bool((prediction.depth > 0).all()) and bool((prediction.K[:, 0, 0] > 1).all())
        return prediction

    def test_a_field_of_view_of_zero(self) -> None:
        network = random_network(TINY)
        network.camera_head.pose_branch.fc2.bias[7:] = -100.0
        prediction = self._check(network)
        assert all(prediction.seen_share(view) == 0 for view in range(3))
        assert torch.equal(prediction.T_first_cam[2], sim3.identity())

    @pytest.mark.parametrize('bias', [200.0, -200.0, float('nan')])
    def test_depths_without_bounds(self, bias: float) -> None:
        network = random_network(TINY)
        layer: Any = network.depth_head.scratch.output_conv2[2]
        layer.bias[0] = bias
        assert self._check(network).seen_share(0) == 0

    def test_confidence_without_bounds(self) -> None:
        network = random_network(TINY)
        layer: Any = network.depth_head.scratch.output_conv2[2]
        layer.bias[1] = 200.0
        assert self._check(network).seen_share(0) == 1

    def test_poses_that_are_not_numbers(self) -> None:
        network = random_network(TINY)
        network.camera_head.pose_branch.fc2.bias[0] = float('nan')
        assert self._check(network).seen_share(0) == 0


class _SmallMemory(Vggt):
    """Runs out of memory, as torch says it on a GPU, with more views than it has room for."""

    room = 2

    def forward(self, begun: Tensor, *args: Any, **kwargs: Any) -> VggtOutput:
        if len(begun) > self.room:
            raise torch.OutOfMemoryError('CUDA out of memory. Tried to allocate 2.00 GiB')
        return super().forward(begun, *args, **kwargs)


def _small_memory(room: int) -> _SmallMemory:
    network = _SmallMemory(TINY)
    network.load_state_dict(random_network(TINY).state_dict())
    network.requires_grad_(False).room = room
    return network


class TestOutOfMemory:
    def test_the_last_views_are_left_out(self, caplog: pytest.LogCaptureFixture) -> None:
        model, roomy = _model(_small_memory(2)), _model()
        encodings = _encodings(model, 4)
        with caplog.at_level(logging.WARNING):
            prediction = model.infer(encodings)
        assert 'at most 2 views' in caplog.messages[-1]
        assert prediction.depth.shape[0] == len(prediction.K) == len(prediction.T_first_cam) == 4
        assert [prediction.seen_share(view) > 0 for view in range(4)] == [True, True, False, False]
        expected = roomy.infer(_encodings(roomy, 2))
        assert parity.difference(prediction.depth[:2], expected.depth) < ROUNDING

    def test_it_is_remembered_and_said_once(self, caplog: pytest.LogCaptureFixture) -> None:
        model = _model(_small_memory(2))
        encodings = _encodings(model, 4)
        with caplog.at_level(logging.WARNING):
            model.infer(encodings)
            said = len(caplog.messages)
            model.infer(encodings)
        assert len(caplog.messages) == said

    def test_what_fits_after_making_room_keeps_the_window(self) -> None:
        """Dropping cached tokens comes first; the window shrinks only if that does not help."""
        network = _small_memory(2)
        model = _model(network)
        encodings = _encodings(model, 3)
        clear = model._cache.clear

        def clear_and_have_room() -> None:
            clear()
            network.room = 3
        model._cache.clear = clear_and_have_room    # type: ignore[method-assign]
        prediction = model.infer(encodings)
        assert all(prediction.seen_share(view) > 0 for view in range(3))

    def test_not_even_one_view(self) -> None:
        model = _model(_small_memory(0))
        with pytest.raises(torch.OutOfMemoryError):
            model.infer(_encodings(model, 2))


class TestMaking:
    def _config(self, **settings: str) -> Config:
        return Config().with_values({'model.name': 'vggt', 'camera.width': str(WIDTH)} | {
            name.replace('__', '.'): value for name, value in settings.items()})

    def test_from_the_settings(self, tmp_path: Path) -> None:
        path = write_checkpoint(tmp_path)
        model = make_model(self._config(model__weights=str(path), model__device='cpu'))
        assert model.min_views == 1
        assert model.infer([model.encode(frame())]).depth.shape == (1, HEIGHT, WIDTH)

    def test_in_bfloat16_and_compiled(self, tmp_path: Path) -> None:
        """Compiled at the first inference only, so that asking for it costs nothing here."""
        model = make_model(self._config(
            model__weights=str(write_checkpoint(tmp_path)), model__device='cpu',
            vggt__precision='bfloat16', vggt__compile='true'))
        assert isinstance(model, VggtModel)
        block: Any = model._network.aggregator.global_blocks[0]
        assert block.mlp.fc1.weight.dtype == torch.bfloat16
        assert block._compiled_call_impl is not None

    def test_without_weights(self) -> None:
        with pytest.raises(ConfigError, match='model.weights.*download_weights'):
            make_model(self._config())

    def test_weights_that_are_not_there(self, tmp_path: Path) -> None:
        with pytest.raises(ConfigError, match='no weights at'):
            make_model(self._config(model__weights=str(tmp_path / 'no.pt')))

    def test_devices(self) -> None:
        assert chosen_device('model.device', 'cpu').type == 'cpu'
        auto = 'cuda' if torch.cuda.is_available() else 'cpu'
        assert chosen_device('model.device', 'auto').type == auto
        with pytest.raises(ConfigError, match='model.device.*expected auto'):
            chosen_device('model.device', 'gpu')
        with pytest.raises(ConfigError, match='model.device: cuda:99 is not there'):
            chosen_device('model.device', 'cuda:99')

    def test_precision_of_the_cpu_is_float32(self) -> None:
        assert making.chosen_dtype('auto', torch.device('cpu')) == torch.float32
        assert making.chosen_dtype('bfloat16', torch.device('cpu')) == torch.bfloat16


@pytest.mark.parametrize('infer', ['on_demand', 'every_image'])
def test_the_frontend_lives_on_whatever_the_network_says(clip: Clip, infer: str) -> None:
    """Random weights cannot track: what is shown is that real images go all the way through."""
    config = Config().with_values({
        'model.name': 'vggt', 'model.weights': str(fixture_path('tiny')), 'model.infer': infer,
        'model.device': 'cpu', 'camera.width': str(WIDTH)})
    pipeline = FrontendPipeline(config, make_model(config))
    for stamp_ns, image in list(zip(clip.stamps_ns, clip.images))[:6]:
        assert pipeline.process(stamp_ns, image, None).status in (
            TrackingStatus.TRACKED, TrackingStatus.LOST, TrackingStatus.INITIALISING)
