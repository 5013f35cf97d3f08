"""Geometric verification of a loop candidate: a false loop is far worse than a missed one."""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass
from typing import Sequence

import torch
from torch import Tensor

from ..config import LoopClosureConfig
from ..geometry import sim3
from ..models.base import GeometryModel
from ..registration.scale import ScaleEstimate, log_depth_ratio
from ..types import Frame, FrameEncoding, KeyframeEvent, WindowPrediction
from .one_way import OneWay, View, register

_ENCODINGS = 32             # kept; a candidate is often looked at again by the next keyframe
_FLOOR = (0.02, 0.01, 0.02)    # least sigma: translation / median depth, rotation, log-scale


@dataclass(frozen=True)
class Verification:
    """What became of a candidate. ``reason`` says why it was refused; '' when accepted.

    T_older_newer: [4,4] float64 Sim(3) between the stored pointmaps, each in its own unit.
    sigma: [7], as PoseEdge has it. matched_fraction: the smaller of the two directions.
    kappa: the larger reduced chi-square of the two.
    """

    accepted: bool
    reason: str
    T_older_newer: Tensor
    sigma: Tensor
    matched_fraction: float = 0.0
    kappa: float = math.inf


@dataclass(frozen=True)
class _BothWays:
    """Forward: the older keyframe's points in the newer image; backward: the other way round."""

    forward: OneWay
    backward: OneWay

    @property
    def scale(self) -> float:
        """From the newer keyframe's unit to the older's: the mean of both directions."""
        return math.sqrt(self.forward.scale.scale / self.backward.scale.scale)

    @property
    def T_older_newer(self) -> Tensor:
        """[2,4,4]: what each direction says, with the common scale."""
        R, t = sim3.rotation_of(self.backward.T_target_ref), self.backward.T_target_ref[:3, 3]
        return torch.stack([sim3.with_scale(sim3.inverse(self.forward.T_target_ref), self.scale),
                            sim3.from_parts(self.scale, R, self.scale * t)])


class LoopVerifier:
    """Asks the model about a candidate, then believes only images and stored pointmaps."""

    def __init__(self, config: LoopClosureConfig, model: GeometryModel) -> None:
        self._config = config
        self._model = model
        self._encodings: OrderedDict[int, FrameEncoding] = OrderedDict()

    def verify(self, newer: KeyframeEvent, older: KeyframeEvent,
               companions: Sequence[KeyframeEvent]) -> Verification:
        """Is the newer keyframe where the older one was, and in which relative pose?

        companions: keyframes that see the same, for parallax in the model's window.
        """
        if newer.image.shape != older.image.shape:
            return _refused('image sizes differ')
        usable = [c for c in companions if c.image.shape == newer.image.shape]
        prediction = self._model.infer([self._encode(e) for e in (newer, older, *usable)])
        if not prediction.rotation_only and min(map(prediction.seen_share, (0, 1))) == 0.0:
            return _refused('not connected by the model')
        view_newer, view_older = View.of(newer), View.of(older)
        T_older_newer = sim3.inverse(prediction.T_first_cam[1])
        forward = register(view_older, view_newer, _in_unit_of(
            older, sim3.inverse(T_older_newer), prediction, 1))
        if forward is None:
            return _refused('not found in the image')
        backward = register(view_newer, view_older, _in_unit_of(
            newer, T_older_newer, prediction, 0))
        if backward is None:
            return _refused('not found in the image')
        return self._judge(_BothWays(forward, backward), view_older.median_depth)

    def _encode(self, event: KeyframeEvent) -> FrameEncoding:
        encoding = self._encodings.pop(event.keyframe_id, None)
        if encoding is None:
            frame = Frame(event.stamp_ns, event.image, event.K,
                          float(event.K[1, 1] / event.K[0, 0]))
            encoding = self._model.encode(frame)
        self._encodings[event.keyframe_id] = encoding
        if len(self._encodings) > _ENCODINGS:
            self._encodings.popitem(last=False)
        return encoding

    def _judge(self, both: _BothWays, median_depth: float) -> Verification:
        matched = min(both.forward.matched_fraction, both.backward.matched_fraction)
        kappa = max(both.forward.kappa, both.backward.kappa)
        spread = max(both.forward.scale.spread, both.backward.scale.spread)
        difference = _difference(both, median_depth)
        T = sim3.mean(both.T_older_newer, torch.ones(2, dtype=torch.float64))
        sigma = _sigma(both, median_depth, difference)
        reason = ''
        if matched < self._config.min_matched:
            reason = 'too few matches'
        elif kappa > self._config.max_kappa:
            reason = 'high chi-square'
        elif not spread < self._config.max_depth_spread:
            reason = 'depths disagree'
        elif not bool((difference < self._config.max_disagreement).all()):
            reason = 'directions disagree'
        return Verification(not reason, reason, T, sigma, matched, kappa)


def _refused(reason: str) -> Verification:
    return Verification(False, reason, sim3.identity(), torch.full((7,), math.inf))


def _in_unit_of(event: KeyframeEvent, T: Tensor, prediction: WindowPrediction,
                view: int) -> Tensor:
    """T, rigid in the prediction's unit, with its translation in the keyframe's unit."""
    if prediction.rotation_only:
        return sim3.from_parts(1.0, sim3.rotation_of(T), torch.zeros(3))
    unit = _unit(event, prediction, view)
    # With nothing to compare, no translation is the only guess left; the images will judge it.
    factor = unit.scale if unit.count else 0.0
    return sim3.from_parts(1.0, sim3.rotation_of(T), factor * sim3.translation_of(T))


def _unit(event: KeyframeEvent, prediction: WindowPrediction, view: int) -> ScaleEstimate:
    """The prediction's unit in the keyframe's, over the pixels that both know."""
    grid = slice(None, None, 4)   # a median needs no more
    stored, predicted = event.points_cam[grid, grid, 2], prediction.depth[view, grid, grid].cpu()
    weights = (event.confidence[grid, grid] - 1.0) \
        * (prediction.confidence[view, grid, grid].cpu() - 1.0)
    confident = weights >= weights.median()
    return log_depth_ratio(stored[confident], predicted[confident],
                           weights[confident].clamp_min(0.0))


def _difference(both: _BothWays, median_depth: float) -> Tensor:
    """[3]: how far the directions are apart in translation / median depth, angle, log-scale."""
    forward, backward = both.T_older_newer
    apart = float((forward[:3, 3] - backward[:3, 3]).norm()) / median_depth
    scale = abs(math.log(both.forward.scale.scale * both.backward.scale.scale))
    return torch.tensor([apart, sim3.angle_rad(forward, backward), scale], dtype=torch.float64)


def _sigma(both: _BothWays, median_depth: float, difference: Tensor) -> Tensor:
    """[7]: of T_older_newer's left perturbation.

    The backward solution perturbs in the older keyframe's frame already. Three independent parts:
    what the solver says, half of what the directions differ by, and a floor.
    """
    solved = torch.from_numpy(both.backward.sigma).clone()
    solved[:3] *= both.scale
    log_scale = max(both.forward.scale.sigma, both.backward.scale.sigma)
    solved = torch.cat([solved, torch.tensor([log_scale], dtype=torch.float64)])
    size = torch.tensor([median_depth, 1.0, 1.0], dtype=torch.float64)
    floor = torch.tensor(_FLOOR, dtype=torch.float64) * size
    other = (floor ** 2 + (0.5 * difference * size) ** 2)[[0, 0, 0, 1, 1, 1, 2]]
    return (solved ** 2 + other).sqrt()
