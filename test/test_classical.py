"""The classical geometry model, from features to depth with confidence."""

from __future__ import annotations

import math
from dataclasses import replace

import clip as clips
import cv2
import numpy as np
import pytest
import torch
from clip import Clip
from torch import Tensor

from aim_slam_ros.config import ClassicalConfig
from aim_slam_ros.geometry import camera, rotation, sim3
from aim_slam_ros.models.base import GeometryModel
from aim_slam_ros.models.classical import bundle, features, matches, sweep
from aim_slam_ros.models.classical.model import ClassicalModel
from aim_slam_ros.types import GUESSED_CONFIDENCE, Frame, WindowPrediction

CONFIG = ClassicalConfig()
WINDOW = (24, 8, 14, 19)    # of the clip: the current view first


def _model() -> ClassicalModel:
    return ClassicalModel(CONFIG, fov_deg=62.7)     # the clip's own


def _infer(frames: list[Frame], model: GeometryModel | None = None) -> WindowPrediction:
    model = model or _model()
    return model.infer([model.encode(frame) for frame in frames])


@pytest.fixture(scope='module')
def window(clip: Clip) -> WindowPrediction:
    return _infer([clip.frame(i) for i in WINDOW])


def _unit(prediction: WindowPrediction, clip: Clip, view: int = 0) -> float:
    """Metres per unit of the prediction, by the depths that it is sure of."""
    sure = prediction.confidence[view] > prediction.confidence[view].quantile(0.7)
    true = clip.depth_of(WINDOW[view])
    return float((true / prediction.depth[view])[sure & (true > 0)].median())


def _points_world(clip: Clip, index: int) -> Tensor:
    """[H,W,3] of the admitted frame, metres."""
    K = clip.frame(index).K
    assert K is not None
    return sim3.transform(clip.T_world_cam[index], camera.unproject(clip.depth_of(index), K))


class TestFeatures:
    def test_keypoints_lie_where_the_image_has_them(self, clip: Clip) -> None:
        """That of a blob is its centre, though it is found at half resolution."""
        v, u = np.mgrid[:240, :322]
        blob = 200.0 * np.exp(-((u - 150.0) ** 2 + (v - 110.0) ** 2) / (2 * 6.0 ** 2))
        grey = (30 + blob).astype(np.uint8)
        uv, _ = features.detect(Frame(0, np.repeat(grey[..., None], 3, 2)), 50)
        assert len(uv) and np.abs(uv - (150, 110)).max() < 0.2

    def test_descriptors_have_unit_length(self, clip: Clip) -> None:
        uv, sift = features.detect(clip.frame(0), CONFIG.features)
        assert 100 < len(uv) == len(sift)
        assert np.allclose(np.linalg.norm(sift, axis=1), 1.0, atol=1e-3)
        assert float(features.global_descriptor(sift).norm()) == pytest.approx(1.0)

    def test_an_image_without_texture_has_none(self) -> None:
        uv, sift = features.detect(Frame(0, np.full((238, 322, 3), 90, np.uint8)), 100)
        assert uv.shape == (0, 2) and sift.shape == (0, 128)
        assert float(features.global_descriptor(sift).norm()) == pytest.approx(1.0)

    def test_near_views_have_similar_descriptors(self, clip: Clip) -> None:
        near, far, here = (features.global_descriptor(features.detect(clip.frame(i), 800)[1])
                           for i in (1, 40, 0))
        assert float(here @ near) > float(here @ far) + 0.1

    def test_the_small_image_forgets_exposure(self, clip: Clip) -> None:
        frame = clip.frame(0)
        brighter = replace(frame, image=(frame.image * 0.6 + 60).astype(np.uint8))
        a, b = features.contrast_normalised(frame), features.contrast_normalised(brighter)
        assert a.shape == (frame.height // 4, frame.width // 4)
        assert a.min() > 0, '0 means outside the image'
        # where there is contrast; in flat parts the rounding to grey levels is what is seen
        assert np.median(np.abs(a.astype(int) - b)) < 8 < a.std()


class TestMatches:
    def test_they_are_the_same_from_both_sides(self, clip: Clip) -> None:
        a, b = (_model().encode(clip.frame(i)).features for i in (0, 3))
        b = replace(b, uid=a.uid + 1)
        there, back = (matches.Matcher(0.9).match(*pair) for pair in ((a, b), (b, a)))
        assert len(there) > 50
        assert set(zip(there.rows_a, there.rows_b)) == set(zip(back.rows_b, back.rows_a))

    def test_they_follow_the_geometry(self, clip: Clip) -> None:
        a, b = (_model().encode(clip.frame(i)).features for i in (0, 3))
        b = replace(b, uid=a.uid + 1)
        found = matches.Matcher(0.9).match(a, b)
        K = clip.frame(0).K
        assert K is not None
        at = torch.from_numpy(a.uv[found.rows_a]).round().long()
        points = camera.unproject(clip.depth_of(0), K)[at[:, 1], at[:, 0]]
        uv = camera.project(sim3.transform(clip.T_a_b(3, 0), points), K)
        error = (uv - torch.from_numpy(b.uv[found.rows_b])).norm(dim=1)
        assert float((error < 3.0).float().mean()) > 0.7

    def test_nothing_matches_nothing(self, clip: Clip) -> None:
        some = _model().encode(clip.frame(0)).features
        none = features.ClassicalFeatures(99, np.zeros((0, 2), np.float32),
                                          np.zeros((0, 128), np.float32), some.small)
        assert len(matches.Matcher(0.9).match(some, none)) == 0
        assert len(matches.Matcher(0.9).match(none, some)) == 0

    def test_essential_pose(self) -> None:
        """With different cameras and a quarter of wrong matches."""
        T, points, K_a = _two_views()
        K_b = camera.intrinsics(300.0, 310.0, 161.0, 120.0)
        uv_a = camera.project(points, K_a).numpy()
        uv_b = camera.project(sim3.transform(T, points), K_b).numpy()
        uv_b[:60] = np.random.default_rng(0).uniform(0, 238, (60, 2))
        found = matches.essential_pose(uv_a, uv_b, K_a, K_b, seed=0)
        assert found is not None
        got, inliers = found
        direction = T[:3, 3] / T[:3, 3].norm()
        assert sim3.angle_rad(got, T) < 0.003
        assert float(got[:3, 3] @ direction) > 0.999
        assert inliers[60:].mean() > 0.9 and inliers[:60].mean() < 0.2


def _two_views(count: int = 240) -> tuple[Tensor, Tensor, Tensor]:
    """T_b_a, points [N,3] in a, and a camera."""
    rng = torch.Generator().manual_seed(0)
    K = camera.intrinsics(270.0, 270.0, 161.0, 119.0)
    uv = torch.rand(count, 2, generator=rng).double() * torch.tensor([322.0, 238.0])
    rays = torch.cat([(uv - K[:2, 2]) / K.diagonal()[:2], torch.ones(count, 1)], 1)
    points = rays * (1.0 + 2.0 * torch.rand(count, 1, generator=rng))
    T = sim3.exp(torch.tensor([0.3, 0.05, -0.1, 0.02, -0.08, 0.03, 0.0], dtype=torch.float64))
    return T, points, K


class TestBundle:
    """Two cameras around a hub."""

    @staticmethod
    def _problem(sigma_px: float = 0.0) -> tuple[bundle.Bundle, bundle.Observations]:
        T, points, K = _two_views()
        other = sim3.exp(torch.tensor([-0.2, 0.2, 0.1, 0.1, 0.05, 0.0, 0.0]).double())
        poses = torch.stack([T, other])
        xy = [sim3.transform(p, points)[:, :2] / sim3.transform(p, points)[:, 2:] for p in poses]
        noise = sigma_px / 270.0 * np.random.default_rng(0).standard_normal((2 * len(points), 2))
        seen = bundle.Observations(np.repeat([0, 1], len(points)),
                                   np.tile(np.arange(len(points)), 2),
                                   torch.cat(xy).numpy() + noise, 270.0)
        z = points[:, 2].numpy()
        return bundle.Bundle(poses.numpy(), points.numpy() / z[:, None], 1.0 / z), seen

    @staticmethod
    def _moved(xi: Tensor, P: Tensor, rho: Tensor) -> Tensor:
        """A point in a camera whose pose is perturbed to first order, at depth 1 / rho."""
        return P + rho * xi[:3] + torch.linalg.cross(xi[3:], P)

    def test_derivatives_are_those_of_automatic_differentiation(self) -> None:
        truth, seen = self._problem(1.0)
        _, J_pose, J_rho = bundle._linearise(truth, seen)
        for k in (0, 3, len(seen.view) - 1):
            T = torch.from_numpy(truth.T_view_hub[seen.view[k]])
            ray = torch.from_numpy(truth.rays[seen.point[k]])
            rho = torch.tensor(truth.rho[seen.point[k]])

            def projected(xi: Tensor, rho: Tensor) -> Tensor:
                P = self._moved(xi, T[:3, :3] @ ray + rho * T[:3, 3], rho)
                return seen.focal_px * P[:2] / P[2]

            by_pose, by_rho = torch.func.jacfwd(projected, (0, 1))(torch.zeros(6).double(), rho)
            assert np.allclose(J_pose[k], by_pose.numpy(), rtol=1e-9, atol=1e-9)
            assert np.allclose(J_rho[k], by_rho.numpy(), rtol=1e-9, atol=1e-9)

    @staticmethod
    def _wrong(truth: bundle.Bundle, error: float = 0.03) -> bundle.Bundle:
        rng = np.random.default_rng(1)
        xi = torch.from_numpy(error * rng.standard_normal((2, 7)))
        xi[:, 6] = 0.0
        poses = (sim3.exp(xi) @ torch.from_numpy(truth.T_view_hub)).numpy()
        return replace(truth, T_view_hub=poses,
                       rho=truth.rho * np.exp(0.2 * rng.standard_normal(len(truth.rho))))

    @staticmethod
    def _errors(got: bundle.Bundle, truth: bundle.Bundle) -> tuple[float, float, float]:
        """Rotation [rad], translation and inverse depth (relative), after the common scale."""
        scale = float(np.median(truth.rho / got.rho))
        a, b = torch.from_numpy(got.T_view_hub), torch.from_numpy(truth.T_view_hub)
        return (max(sim3.angle_rad(x, y) for x, y in zip(a, b)),
                float((a[:, :3, 3] / scale - b[:, :3, 3]).norm(dim=1).max()),
                float(np.median(np.abs(np.log(got.rho * scale / truth.rho)))))

    def test_it_returns_to_the_truth(self) -> None:
        truth, seen = self._problem()
        got = bundle.adjust(self._wrong(truth), seen, iterations=30)
        rotation, translation, depth = self._errors(got.bundle, truth)
        # the weak prior on the inverse depths (1 px^2) is all that is left
        assert rotation < 1e-3 and translation < 3e-3 and depth < 3e-3
        assert np.median(got.residual_px) < 0.05

    def test_wrong_matches_do_not_pull(self) -> None:
        truth, seen = self._problem(0.3)
        xy = seen.xy.copy()
        xy[::6] += 0.1 * np.random.default_rng(2).standard_normal((len(xy[::6]), 2))
        got = bundle.adjust(self._wrong(truth), replace(seen, xy=xy), iterations=30)
        rotation, translation, depth = self._errors(got.bundle, truth)
        assert rotation < 5e-3 and translation < 0.02 and depth < 0.02
        assert np.median(got.residual_px[::6]) > 5.0 > 1.0 > np.median(got.residual_px)

    def test_it_never_makes_the_cost_larger(self) -> None:
        truth, seen = self._problem(0.5)
        start = self._wrong(truth, 0.3)
        costs = [bundle.adjust(start, seen, iterations=n).cost for n in range(12)]
        assert (np.diff(costs) <= 0).all() and costs[-1] < 0.5 * costs[0]

    def test_without_parallax_the_depths_stay_finite(self) -> None:
        truth, seen = self._problem()
        still = replace(truth, T_view_hub=np.stack([np.eye(4)] * 2))
        xy = np.tile(truth.rays[:, :2], (2, 1))
        got = bundle.adjust(still, replace(seen, xy=xy), iterations=20).bundle
        assert np.isfinite(got.T_view_hub).all() and (got.rho > 0).all()

    def test_derivatives(self) -> None:
        """Against central differences; a pose moves by a left perturbation."""
        truth, seen = self._problem()
        _, J_pose, J_rho = bundle._linearise(truth, seen)
        h = 1e-6
        for axis in range(6):
            step = np.zeros(6)
            step[axis] = h
            plus, minus = (bundle._linearise(replace(truth, T_view_hub=np.stack(
                [bundle._retract(T, s * step) for T in truth.T_view_hub])), seen)[0]
                for s in (1, -1))
            assert np.allclose((plus - minus) / (2 * h), J_pose[:, :, axis], atol=1e-3)
        plus, minus = (bundle._linearise(replace(truth, rho=truth.rho + s * h), seen)[0]
                       for s in (1, -1))
        assert np.allclose((plus - minus) / (2 * h), J_rho, atol=1e-3)


class TestSweep:
    """A slanted plane seen by two cameras, at the size of the model's small images."""

    K = np.array([[70.0, 0, 40], [0, 70.0, 30], [0, 0, 1]])
    T = np.array([[1.0, 0, 0, -0.15], [0, 1, 0, 0.0], [0, 0, 1, 0], [0, 0, 0, 1]])

    def _views(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Reference and source image, and the reference's inverse depth [h,w]."""
        texture = np.random.default_rng(0).integers(1, 255, (45, 60)).astype(np.uint8)
        texture = cv2.resize(texture, (180, 135), interpolation=cv2.INTER_CUBIC)
        texture = np.clip(texture, 1, 255)
        source = np.ascontiguousarray(texture[30:90, 40:120])
        normal = np.array([0.2, 0.1, 0.6])      # n . X = 1: rho = n . K^-1 p
        H = self.K @ (self.T[:3, :3] + np.outer(self.T[:3, 3], normal)) @ np.linalg.inv(self.K)
        shift = np.array([[1.0, 0, 40], [0, 1, 30], [0, 0, 1]])
        reference = cv2.warpPerspective(texture, shift @ H, (80, 60),
                                        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
        v, u = np.mgrid[:60, :80]
        rays = np.stack([(u - 40) / 70, (v - 30) / 70, np.ones((60, 80))], -1)
        return reference, source, rays @ normal

    def test_it_finds_the_depth_and_knows_where(self) -> None:
        reference, source, rho = self._views()
        got = sweep.sweep(reference, self.K, [sweep.Source(source, self.K, self.T)],
                          (0.2, 1.0), 48)
        error = np.abs(np.log(got.rho / rho))
        assert got.score.min() >= 0 and got.score.max() <= 1
        inner = np.zeros_like(rho, bool)
        inner[8:-8, 20:-8] = True       # the left edge is outside the source
        assert np.median(error[inner]) < 0.02
        assert got.score[inner].mean() > 0.4 > 0.1 > got.score[8:-8, :6].mean()

    def test_outside_a_source_nothing_matches(self) -> None:
        """Dark parts must not match the black that lies beyond the source's border."""
        reference, source, _ = self._views()
        reference[:, :12] = 1 + reference[:, :12] // 30
        got = sweep.sweep(reference, self.K, [sweep.Source(source, self.K, self.T)],
                          (0.2, 1.0), 48)
        assert got.score[8:-8, :6].mean() < 0.1

    def test_nothing_is_sure_without_texture(self) -> None:
        flat = np.full((60, 80), 128, np.uint8)
        got = sweep.sweep(flat, self.K, [sweep.Source(flat, self.K, self.T)], (0.2, 1.0), 16)
        assert got.score[10:-10, 25:-10].max() < 0.05 and np.isfinite(got.rho).all()

    def test_agreement_is_between_the_same_points(self) -> None:
        _, _, rho = self._views()
        view = sweep.SweepDepth(rho.astype(np.float32), np.ones((60, 80), np.float32))
        same = sweep.agreement(view, self.K, view, self.K, np.eye(4))
        assert same[1:-1, 1:-1].min() > 0.9
        other = replace(view, rho=(rho * 1.3).astype(np.float32))
        assert sweep.agreement(view, self.K, other, self.K, np.eye(4)).max() < 0.1
        aside = np.eye(4)
        aside[0, 3] = 50.0
        assert sweep.agreement(view, self.K, view, self.K, aside).max() == 0.0

    def test_fill_keeps_what_is_known_and_continues_it(self) -> None:
        rho = np.tile(np.linspace(0.5, 1.0, 80, dtype=np.float32), (60, 1))
        weight = np.ones_like(rho)
        weight[20:40, 30:50] = 1e-4
        spoilt = rho.copy()
        spoilt[20:40, 30:50] = 5.0
        got = sweep.fill(spoilt, weight)
        assert np.abs(got - rho)[:, :25].max() < 1e-5
        assert np.abs(got - rho)[20:40, 30:50].max() < 0.15
        assert np.isfinite(sweep.fill(rho, np.zeros_like(rho))).all()


class TestModel:
    def test_poses_are_right_up_to_scale(self, clip: Clip, window: WindowPrediction) -> None:
        assert not window.rotation_only
        assert torch.allclose(window.T_first_cam[0], sim3.identity(), rtol=0, atol=1e-12)
        assert torch.allclose(sim3.scale_of(window.T_first_cam), torch.ones(4).double())
        unit = _unit(window, clip)
        for view in (1, 2, 3):
            truth = clip.T_a_b(WINDOW[0], WINDOW[view])
            got = sim3.rigid_part(window.T_first_cam[view])
            assert math.degrees(sim3.angle_rad(got, truth)) < 1.5
            # two per cent of a median depth of 2 to 3 m (half of a good window's error)
            assert float((unit * got[:3, 3] - truth[:3, 3]).norm()) < 0.06

    def test_depth_is_right_where_it_is_sure(self, clip: Clip, window: WindowPrediction) -> None:
        for view in (0, 1):
            true = clip.depth_of(WINDOW[view])
            error = (window.depth[view] * _unit(window, clip, view) / true).log().abs()
            confidence = window.confidence[view]
            sure = confidence > confidence.median()
            # On real images: 2.5 to 4 per cent over the confident half, 5 to 6 over all
            assert float(error[sure].median()) < 0.04
            assert float(error[sure].mean()) < 0.6 * float(error[~sure].mean())

    def test_one_window_has_one_unit(self, clip: Clip, window: WindowPrediction) -> None:
        units = [_unit(window, clip, view) for view in range(4)]
        assert max(units) < 1.06 * min(units)

    def test_shapes_and_ranges(self, clip: Clip, window: WindowPrediction) -> None:
        frame = clip.frame(0)
        assert window.depth.shape == window.confidence.shape == (4, frame.height, frame.width)
        assert window.K.shape == (4, 3, 3) and window.depth.dtype == torch.float32
        assert bool((window.confidence > 1.0).all()) and bool((window.depth > 0).all())
        assert bool(torch.isfinite(window.depth).all())

    def test_the_same_window_gives_the_same_again(self, clip: Clip,
                                                  window: WindowPrediction) -> None:
        cv2.setRNGSeed(12345)
        again = _infer([clip.frame(i) for i in WINDOW])
        assert torch.equal(again.depth, window.depth)
        assert torch.equal(again.T_first_cam, window.T_first_cam)

    def test_a_rotation_gives_a_prior_and_says_so(self, clip: Clip) -> None:
        frame, turn = clip.frame(10), (0.02, 0.12, 0.03)
        assert frame.K is not None
        image = clips.turned(frame.image, frame.K.numpy(), turn)
        got = _infer([frame, replace(frame, image=image, stamp_ns=1)])
        assert got.rotation_only
        assert got.confidence.max() < GUESSED_CONFIDENCE
        assert got.seen_share(0) == got.seen_share(1) == 0.0
        truth = torch.from_numpy(cv2.Rodrigues(np.array(turn))[0])
        R = got.T_first_cam[1, :3, :3]
        assert float(rotation.fit_rotation(R.T, truth.T).trace()) > 2.9
        assert math.degrees(math.acos(min(1.0, (float((R @ truth).trace()) - 1) / 2))) < 0.5
        assert float(got.T_first_cam[1, :3, 3].norm()) == 0.0

    @pytest.mark.parametrize('gate_px, rotation_only', [(0.0, False), (100.0, True)])
    def test_the_gate_is_a_parallax(self, clip: Clip, gate_px: float,
                                    rotation_only: bool) -> None:
        config = replace(CONFIG, rotation_gate_px=gate_px)
        got = _infer([clip.frame(i) for i in (24, 19)], ClassicalModel(config, 62.7))
        assert got.rotation_only == rotation_only
        assert (got.seen_share(0) == 0.0) == rotation_only

    def test_standing_still_is_a_rotation_too(self, clip: Clip) -> None:
        got = _infer([clip.frame(5), replace(clip.frame(5), stamp_ns=9)])
        assert got.rotation_only and got.confidence.max() < GUESSED_CONFIDENCE

    def test_views_of_elsewhere_do_not_connect(self, clip: Clip) -> None:
        frames = [clip.frame(i) for i in (24, 16)]
        strange = replace(frames[0], image=np.ascontiguousarray(
            clips.noise(1, (frames[0].width, frames[0].height))))
        got = _infer([*frames, strange])
        assert not got.rotation_only and got.seen_share(0) > 0.2
        assert got.seen_share(2) == 0.0, 'the unconnected view must not claim to see'

    def test_two_strangers_see_nothing(self, clip: Clip) -> None:
        frame = clip.frame(0)
        strange = replace(frame, image=clips.noise(1, (frame.width, frame.height)))
        got = _infer([frame, strange])
        assert got.confidence.max() < GUESSED_CONFIDENCE
        assert bool(torch.isfinite(got.depth).all())
        assert bool(torch.isfinite(got.T_first_cam).all())

    def test_a_wall_without_texture_is_a_guess(self, clip: Clip) -> None:
        """Everything within .9 m of a point is grey: the edge can be seen, the middle cannot."""
        frames, reach = [], []
        centre = _points_world(clip, WINDOW[0])[120, 160]
        for i in WINDOW[:3]:
            reach.append((_points_world(clip, i) - centre).norm(dim=-1))
            image = clip.frame(i).image.copy()
            image[(reach[-1] < 0.9).numpy()] = 128
            frames.append(replace(clip.frame(i), image=image))
        confidence = _infer(frames).confidence[0]
        assert int((reach[0] < 0.3).sum()) > 500, 'the wall is in view'
        inside, around = confidence[reach[0] < 0.3], confidence[reach[0] > 1.2]
        assert float(inside.median()) < GUESSED_CONFIDENCE < 2.0 < float(around.quantile(0.8))

    def test_intrinsics_are_the_frames_or_the_assumed_ones(self, clip: Clip,
                                                           window: WindowPrediction) -> None:
        frame = clip.frame(WINDOW[0])
        assert frame.K is not None and torch.equal(window.K[0], frame.K)
        unknown = [replace(clip.frame(i), K=None) for i in (24, 14)]
        K = ClassicalModel(CONFIG, fov_deg=90.0).infer(
            [_model().encode(f) for f in unknown]).K[0]
        assert float(K[0, 0]) == pytest.approx(frame.width / 2)
        assert float(K[1, 1] / K[0, 0]) == pytest.approx(frame.aspect)

    def test_too_few_views_and_mixed_sizes_are_refused(self, clip: Clip) -> None:
        with pytest.raises(ValueError, match='needs 2 views, not 1'):
            _infer([clip.frame(0)])
        small = replace(clip.frame(1), image=clip.frame(1).image[:196])
        with pytest.raises(ValueError, match='same size'):
            _infer([clip.frame(0), small])
