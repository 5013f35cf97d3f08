"""Depth and pose of a recording's images, as the simulated model asks for them."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from aim_slam_ros.datasets.base import Calibration, DatasetError, ImageError, Sequence
from aim_slam_ros.geometry import sim3
from aim_slam_ros.recorded_truth import RecordedTruth, pose_at
from aim_slam_ros.types import StampedPoses

MS = 1_000_000
SPEED = torch.tensor([1.0, 0.0, 0.0, 0.0, 0.5, 0.0, 0.0]).double()    # per second, turning
CALIBRATION = Calibration(np.array([[50.0, 0.0, 3.5], [0.0, 50.0, 2.5], [0.0, 0.0, 1.0]]))


def pose(stamp_ns: int) -> torch.Tensor:
    return sim3.exp(SPEED * (stamp_ns / 1e9))


def poses(*stamps_ns: int) -> StampedPoses:
    return StampedPoses(np.array(stamps_ns), np.stack([pose(s).numpy() for s in stamps_ns]))


class Recording(Sequence):
    """Images every 40 ms: a good depth, none, a torn file, an empty one, holes, good ones."""

    def __init__(self, calibration: Calibration | None = CALIBRATION,
                 groundtruth: StampedPoses | None = poses(0, 50 * MS, 100 * MS, 150 * MS,
                                                          200 * MS)) -> None:
        super().__init__('made up', np.arange(7) * 40 * MS, calibration, groundtruth)

    def image(self, index: int) -> np.ndarray:
        return np.zeros((6, 8, 3), np.uint8)

    def depth(self, index: int) -> np.ndarray | None:
        if index == 1:
            return None
        if index == 2:
            raise ImageError('depth/2.png', 'the file is cut short')
        depth = np.full((6, 8), 2.0 if index != 3 else 0.0, np.float32)
        if index == 4:
            depth[0, :3] = np.nan, np.inf, -1.0
        return depth


def test_depth_camera_and_pose_of_an_image() -> None:
    truth = RecordedTruth(Recording()).at(160 * MS)
    assert truth is not None
    assert truth.depth.dtype == np.float32
    assert truth.depth[0, :3].tolist() == [0.0, 0.0, 0.0] and (truth.depth[1:] == 2.0).all()
    assert torch.equal(truth.K, torch.from_numpy(CALIBRATION.K))
    # between poses of a steady turn, whatever its frame of reference
    assert torch.allclose(truth.T_world_cam, pose(160 * MS), atol=1e-12)


def test_depth_with_fewer_pixels_has_a_camera_of_its_own(caplog: pytest.LogCaptureFixture) -> None:
    class Coarse(Recording):
        def depth(self, index: int) -> np.ndarray | None:
            depth = super().depth(index)
            return None if depth is None else depth[:side, ::2]
    side = 3
    truth = RecordedTruth(Coarse()).at(0)
    assert truth is not None and truth.depth.shape == (3, 4)
    # the middle of the image, (3.5, 2.5), is the middle of the depth
    assert truth.K.tolist() == [[25.0, 0.0, 1.5], [0.0, 25.0, 1.0], [0.0, 0.0, 1.0]]
    side = 2
    assert RecordedTruth(Coarse()).at(0) is None and 'register it' in caplog.text


@pytest.mark.parametrize('stamp_ns', [
    40 * MS, 80 * MS, 120 * MS,     # without depth, torn, empty
    240 * MS,                       # after the last pose
    1, 10**15])                     # of no image
def test_what_is_not_known(stamp_ns: int) -> None:
    assert RecordedTruth(Recording()).at(stamp_ns) is None


def test_without_calibration_or_ground_truth_nothing_is_known() -> None:
    assert RecordedTruth(Recording(calibration=None)).at(0) is None
    assert RecordedTruth(Recording(groundtruth=None)).at(0) is None


def test_a_pose_is_not_made_up_across_a_gap_or_beyond_the_ends() -> None:
    path = poses(100 * MS, 150 * MS, 300 * MS)
    for known in (100, 125, 150, 300):
        found = pose_at(path, known * MS)
        assert found is not None and torch.allclose(found, pose(known * MS), atol=1e-12)
    for unknown in (99, 151, 299, 301):
        assert pose_at(path, unknown * MS) is None


def test_images_with_depth() -> None:
    assert RecordedTruth(Recording()).with_depth(range(7)) == [0, 4, 5]
    assert RecordedTruth(Recording(groundtruth=None)).with_depth(range(1, 7)) == [4, 5, 6]


def test_what_is_missing_is_named() -> None:
    RecordedTruth(Recording()).require([0, 4, 5])
    for recording, text in ((Recording(), '2 of the 3 images have no depth.*--with-depth'),
                            (Recording(calibration=None), 'no calibration.*another model'),
                            (Recording(groundtruth=None), 'no ground truth.*another model')):
        with pytest.raises(DatasetError, match=text):
            RecordedTruth(recording).require(range(3))
