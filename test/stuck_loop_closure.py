"""The loop-closure node with a model whose answers do not come while a test lasts."""

from __future__ import annotations

import sys
import time
from typing import Sequence

from room_walk import RoomModel

from aim_slam_ros.nodes.loop_closure_node import LoopClosureNode
from aim_slam_ros.nodes.running import run
from aim_slam_ros.types import FrameEncoding, WindowPrediction


class StuckModel(RoomModel):
    def infer(self, encodings: Sequence[FrameEncoding]) -> WindowPrediction:
        print('the model is asked', flush=True)
        time.sleep(600.0)
        return super().infer(encodings)


if __name__ == '__main__':
    sys.exit(run(lambda: LoopClosureNode(StuckModel()), sys.argv))
