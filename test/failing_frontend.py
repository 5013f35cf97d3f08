"""The frontend node with a model that fails from SIGUSR1 on."""

from __future__ import annotations

import signal
import sys
from typing import Sequence

from aim_slam_ros.models.base import GeometryModel
from aim_slam_ros.nodes.frontend_node import FrontendNode
from aim_slam_ros.nodes.running import run
from aim_slam_ros.types import Frame, FrameEncoding, WindowPrediction


class FailingModel:
    def __init__(self, model: GeometryModel) -> None:
        self.min_views = model.min_views
        self._model, self._fails = model, False
        signal.signal(signal.SIGUSR1, self._fail)

    def encode(self, frame: Frame) -> FrameEncoding:
        return self._model.encode(frame)

    def infer(self, encodings: Sequence[FrameEncoding]) -> WindowPrediction:
        if self._fails:
            raise RuntimeError('another program took the memory')
        return self._model.infer(encodings)

    def _fail(self, *unused: object) -> None:
        self._fails = True
        print('from now on the model fails', flush=True)


if __name__ == '__main__':
    sys.exit(run(lambda: FrontendNode(FailingModel), sys.argv))
