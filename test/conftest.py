"""What several test files share and is made once."""

from __future__ import annotations

import os

import clip as clips
import cv2
import pytest
import torch

# Processes of a test session meet each other and nobody else; from 102 on the ports of a domain
# are those that the system gives to outgoing connections.
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
os.environ['ROS_DOMAIN_ID'] = str(1 + os.getpid() % 101)

# Images are small: threads cost more than they bring, and results are the same for every count.
torch.set_num_threads(1)
cv2.setNumThreads(1)


@pytest.fixture(scope='session')
def clip(tmp_path_factory: pytest.TempPathFactory) -> clips.Clip:
    return clips.make(tmp_path_factory.mktemp('rendered') / 'room')
