"""Intrinsics over real serialisation."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from sensor_msgs.msg import CameraInfo, RegionOfInterest
from wire import as_in_bag, over_wire

from msg_adapters.encodings import (K_from_camera_info, has_distortion, is_rectified,
                                    published_size)
from msg_adapters.errors import MessageError
from msg_adapters.images import camera_info_msg
from msg_adapters.stamps import stamp_ns

K = np.array([[517.3, 0.0, 318.6], [0.0, 516.5, 255.3], [0.0, 0.0, 1.0]])


def test_round_trip_is_exact() -> None:
    msg = camera_info_msg(K, 640, 480, 5_000_000_001, 'cam', [0.2, -0.9, 0.0, 0.0, 1.1])
    assert (msg.width, msg.height, msg.header.frame_id) == (640, 480, 'cam')
    assert stamp_ns(msg.header.stamp) == 5_000_000_001
    for read in (over_wire(msg), as_in_bag(msg)):
        np.testing.assert_array_equal(K_from_camera_info(read), K)
        assert has_distortion(read)


@pytest.mark.parametrize('distortion', [None, [0.0] * 5, []])
def test_no_distortion(distortion: list[float] | None) -> None:
    assert not has_distortion(over_wire(camera_info_msg(K, 640, 480, 0, 'cam', distortion)))


def test_eight_coefficients_are_the_rational_model() -> None:
    msg = over_wire(camera_info_msg(K, 640, 480, 0, 'cam', [0.1] * 8))
    assert (msg.distortion_model, len(msg.d)) == ('rational_polynomial', 8)


def test_zeros_say_that_the_camera_is_not_calibrated() -> None:
    assert K_from_camera_info(over_wire(CameraInfo(width=640, height=480))) is None
    assert K_from_camera_info(over_wire(camera_info_msg(None, 640, 480, 0, 'cam'))) is None


def test_names_of_ros_1() -> None:
    msg = SimpleNamespace(K=K.reshape(-1), D=np.zeros(5))
    np.testing.assert_array_equal(K_from_camera_info(msg), K)
    assert not has_distortion(msg)


def test_binning_and_region_of_interest() -> None:
    """As CameraInfo defines them: K is that of the full sensor."""
    msg = camera_info_msg(K, 640, 480, 0, 'cam')
    msg.binning_x, msg.binning_y = 2, 4
    msg.roi = RegionOfInterest(x_offset=10, y_offset=20)
    found = K_from_camera_info(over_wire(msg))
    assert found is not None
    np.testing.assert_allclose(found[[0, 1, 0, 1], [0, 1, 2, 2]],
                               [517.3 / 2, 516.5 / 4, 308.6 / 2, 235.3 / 4])


@pytest.mark.parametrize('row, column, value, text', [
    (0, 0, np.nan, 'not finite'),
    (1, 2, np.inf, 'not finite'),
    (0, 0, 0.0, 'must be positive'),
    (1, 1, -500.0, 'must be positive'),
])
def test_bad_intrinsics_are_named(row: int, column: int, value: float, text: str) -> None:
    msg = camera_info_msg(K, 640, 480, 0, 'cam')
    msg.k[3 * row + column] = value
    with pytest.raises(MessageError, match=text):
        K_from_camera_info(over_wire(msg))


def test_size_of_the_images_as_they_are_published() -> None:
    msg = camera_info_msg(K, 640, 480, 0, 'cam')
    assert published_size(over_wire(msg)) == (640, 480)
    msg.binning_x = msg.binning_y = 2
    assert published_size(over_wire(msg)) == (320, 240)
    msg.roi.width, msg.roi.height = 200, 100
    assert published_size(over_wire(msg)) == (100, 50)


def test_p_is_the_camera_of_rectified_images() -> None:
    msg = camera_info_msg(K, 640, 480, 0, 'cam', [0.2, -0.9, 0.0, 0.0, 1.1])
    msg.p[0] = msg.p[5] = 400.0
    read = over_wire(msg)
    assert is_rectified('/cam/image_rect/compressed', read)
    assert not is_rectified('/cam/image_raw', read)
    assert not is_rectified('/cam/image_rect', CameraInfo())
    found = K_from_camera_info(read, rectified=True)
    assert found is not None and found[0, 0] == found[1, 1] == 400.0
    assert found[0, 2] == K[0, 2] and found.shape == (3, 3)


def test_too_few_values_are_named() -> None:
    with pytest.raises(MessageError, match='4 values instead of 9'):
        K_from_camera_info(SimpleNamespace(k=[1.0, 2.0, 3.0, 4.0]))
