"""Dense work follows the device that pointmaps are kept on: one code path, whatever the device."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import Sequence

import clip as clips
import pytest
import torch
from clip import Clip
from elsewhere import DEVICE, Elsewhere, MixedDevices
from true_model import TrueModel

from aim_slam_ros.config import Config, ConfigError
from aim_slam_ros.devices import chosen_device
from aim_slam_ros.frontend.pipeline import FrontendPipeline
from aim_slam_ros.types import FrameResult, TrackingStatus

IMAGES = 12
STEP_NS = 33_000_000


def _results(config: Config, model: TrueModel, clip: Clip) -> list[FrameResult]:
    pipeline = FrontendPipeline(config, model)
    return [pipeline.process((1 + i) * STEP_NS, clip.images[i], clip.K)
            for i in range(0, len(clip), max(1, len(clip) // IMAGES))]


def _same(a: Sequence[FrameResult], b: Sequence[FrameResult]) -> bool:
    return all((x.status, x.window, x.kappa) == (y.status, y.window, y.kappa)
               and torch.equal(x.T_world_cam, y.T_world_cam)   # type: ignore[arg-type]
               and all(torch.equal(e.points_cam, f.points_cam)
                       and torch.equal(e.confidence, f.confidence)
                       and f.points_cam.device.type == 'cpu'
                       for e, f in zip(x.events, y.events, strict=True))
               for x, y in zip(a, b, strict=True))


@pytest.mark.parametrize('tracker', ['image', 'paper'])
def test_a_map_on_another_device_gives_the_same_to_the_last_bit(clip: Clip, tracker: str) -> None:
    settings = {'model.infer': 'every_image', 'tracking.tracker': tracker, 'sigma.kappa': '0.0',
                'keyframes.promote_below': '0.95'}
    model = TrueModel(clip)
    here = _results(clips.config().with_values(settings), model, clip)
    assert model.widest > 3, 'no window was widened'
    with Elsewhere() as elsewhere:
        there = _results(clips.config().with_values(
            settings | {'keyframes.device': str(DEVICE)}), TrueModel(clip), clip)
    assert elsewhere.operations > 100 * IMAGES, 'dense work was not done there'
    assert all(r.status is TrackingStatus.TRACKED for r in here), [r.reason for r in here]
    assert _same(here, there)


def test_elsewhere_refuses_what_a_gpu_refuses() -> None:
    with Elsewhere():
        there = torch.ones(3).to(DEVICE)
        assert float((there * 2 + torch.tensor(1.0)).sum()) == 9.0
        with pytest.raises(MixedDevices):
            there + torch.ones(3)
        with pytest.raises((RuntimeError, TypeError)):
            there.numpy()


def test_a_device_that_is_not_there_is_refused_at_the_start(clip: Clip) -> None:
    config = Config().with_values({'keyframes.device': 'cuda:99'})
    with pytest.raises(ConfigError, match='keyframes.device: cuda:99 is not there'):
        FrontendPipeline(config, TrueModel(clip))
    with pytest.raises(ConfigError, match="keyframes.device: 'gpu' is not allowed"):
        chosen_device('keyframes.device', 'gpu')


@pytest.mark.parametrize('said, spins', [({}, '10000'), ({'GOMP_SPINCOUNT': '7'}, '7'),
                                         ({'OMP_WAIT_POLICY': 'PASSIVE'}, 'None')])
def test_idle_threads_wait_shortly_unless_the_user_says_otherwise(said: dict[str, str],
                                                                  spins: str) -> None:
    known = {k: v for k, v in os.environ.items() if k not in ('GOMP_SPINCOUNT', 'OMP_WAIT_POLICY')}
    script = ("import sys, os, aim_slam_ros; assert 'torch' not in sys.modules; "
              "print(os.environ.get('GOMP_SPINCOUNT'))")
    printed = subprocess.run([sys.executable, '-c', script], env=known | said, check=True,
                             capture_output=True, text=True).stdout
    assert printed.strip() == spins
