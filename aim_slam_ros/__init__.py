"""AIM-SLAM for ROS 2."""

from __future__ import annotations

import os

# To be said before torch is imported. Idle threads of its OpenMP (libgomp) would otherwise wait
# busily for some milliseconds, on cores that OpenCV and the other nodes have work for; asleep at
# once, dense work pays for waking them. Between the two, a sixth more images per second.
if 'OMP_WAIT_POLICY' not in os.environ:
    os.environ.setdefault('GOMP_SPINCOUNT', '10000')
