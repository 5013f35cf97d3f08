"""VGGT in the nodes, over DDS: random weights cannot track, the way through is what is shown."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from ros_peer import Peer, Process, wait_for
from sensor_msgs.msg import Image, PointCloud2
from vggt_tiny import WIDTH, fixture_path

from aim_slam_ros.types import TrackingStatus
from msg_adapters import images
from msg_adapters.frames import frame_report

RECORDED = Path(__file__).resolve().parents[2] / 'shared' / 'data' / 'tum_fr1_xyz' / 'rgb'
IMAGES = 6
ANSWERS = {TrackingStatus.INITIALISING, TrackingStatus.TRACKED, TrackingStatus.LOST}


def _recorded() -> list[np.ndarray]:
    """Some real images, [H,W,3] uint8 RGB."""
    paths = sorted(RECORDED.glob('*.*'), key=lambda path: float(path.stem))[:10 * IMAGES:10]
    if not paths:
        pytest.skip(f'the recording {RECORDED} is not here')
    return [cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB) for path in paths]


@pytest.mark.parametrize('executable', ['frontend', 'slam'])
def test_real_images_go_through_and_the_node_lives_on(tmp_path: Path, executable: str) -> None:
    recorded, weights = _recorded(), fixture_path('tiny') / 'weights.safetensors'
    settings = {'model.name': 'vggt', 'model.weights': str(weights), 'model.device': 'cpu',
                'model.infer': 'every_image', 'camera.width': str(WIDTH), 'publish_tf': 'false'}
    arguments = [word for name, value in settings.items() for word in ('-p', f'{name}:={value}')]
    with Peer() as peer, Process(tmp_path / 'node.log', f'aim_slam_ros.cli.{executable}',
                                 '--ros-args', *arguments) as process:
        rows = peer.hear(PointCloud2, 'frame')
        image = peer.publisher(Image, 'image')
        wait_for(lambda: peer.node.count_publishers('frame'), 'the frontend')
        for i, rgb in enumerate(recorded, 1):
            seen = len(rows)
            image.publish(images.image_msg(rgb, i * 10 ** 9, 'camera_optical_frame'))
            wait_for(lambda: len(rows) > seen, f'an answer to image {i}')
        statuses = {frame_report(row).result.status for row in list(rows)}
        assert statuses <= ANSWERS, statuses
        assert process.alive and 'VGGT runs on the CPU' in process.output
        assert 'Traceback' not in process.output, process.output


def test_without_weights_it_says_so_and_ends(tmp_path: Path) -> None:
    with Process(tmp_path / 'node.log', 'aim_slam_ros.cli.frontend', '--ros-args',
                 '-p', 'model.name:=vggt', '-p', 'publish_tf:=false') as process:
        assert process.ended() == 2
        assert 'model.weights' in process.output and 'download_weights' in process.output
        assert 'Traceback' not in process.output
