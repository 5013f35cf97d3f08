"""Images over real serialisation: every encoding, and everything that can be wrong with one."""

from __future__ import annotations

import itertools
import subprocess
import sys
from pathlib import Path
from typing import Any, Callable

import cv2
import numpy as np
import pytest
from sensor_msgs.msg import CompressedImage, Image
from wire import as_in_bag, over_wire

from msg_adapters.encodings import ENCODINGS, rgb_from_compressed, rgb_from_image
from msg_adapters.errors import MessageError
from msg_adapters.images import compressed_msg, image_msg
from msg_adapters.payload import data_of
from msg_adapters.stamps import stamp_ns

STAMP = 1_305_031_102_175_304_001
PATCH = 16
COLOURS = np.array([[220, 30, 20], [25, 210, 40], [35, 50, 230], [128, 128, 128]], np.uint8)
# Four patches side by side: red, green, blue, grey.
PICTURE = np.repeat(COLOURS, PATCH, axis=0)[None].repeat(PATCH, axis=0).copy()
GREY = np.rint(PICTURE @ np.array([0.299, 0.587, 0.114])).astype(np.uint8)


def _bayer(pattern: str) -> np.ndarray:
    """One colour per pixel; the pattern is that of the upper left 2x2 pixels, row by row."""
    mosaic = np.empty(PICTURE.shape[:2], np.uint8)
    for (row, column), name in zip(itertools.product((0, 1), (0, 1)), pattern):
        mosaic[row::2, column::2] = PICTURE[row::2, column::2, 'rgb'.index(name)]
    return mosaic


def _yuv422(luma_at: int) -> np.ndarray:
    """BT.601 in studio range, two pixels sharing u and v. luma_at: 1 for UYVY, 0 for YUYV."""
    r, g, b = np.moveaxis(PICTURE.astype(np.float64) / 255.0, -1, 0)
    y = 16 + 65.481 * r + 128.553 * g + 24.966 * b
    u = 128 - 37.797 * r - 74.203 * g + 112.0 * b
    v = 128 + 112.0 * r - 93.786 * g - 18.214 * b
    out = np.empty((*y.shape, 2))
    out[..., luma_at] = y
    out[:, 0::2, 1 - luma_at], out[:, 1::2, 1 - luma_at] = u[:, 0::2], v[:, 0::2]
    return np.rint(out).astype(np.uint8)


def _with_alpha(image: np.ndarray) -> np.ndarray:
    return np.concatenate([image, np.full((*image.shape[:2], 1), 77, np.uint8)], -1)


def _wide(image: np.ndarray) -> np.ndarray:
    """16 bits per sample; the lower byte is there and does not matter."""
    return image.astype('<u2') * 256 + 99


BGR = PICTURE[..., ::-1]
SAMPLES: dict[str, np.ndarray] = {
    'rgb8': PICTURE, 'bgr8': BGR, 'rgba8': _with_alpha(PICTURE), 'bgra8': _with_alpha(BGR),
    'rgb16': _wide(PICTURE), 'bgr16': _wide(BGR), 'rgba16': _wide(_with_alpha(PICTURE)),
    'bgra16': _wide(_with_alpha(BGR)), '8UC3': BGR, '8UC4': _with_alpha(BGR), '16UC3': _wide(BGR),
    'mono8': GREY, '8UC1': GREY, 'mono16': _wide(GREY), '16UC1': _wide(GREY),
    'yuv422': _yuv422(1), 'uyvy': _yuv422(1), 'yuv422_yuy2': _yuv422(0), 'yuyv': _yuv422(0),
    **{f'bayer_{p}8': _bayer(p) for p in ('rggb', 'bggr', 'gbrg', 'grbg')},
    **{f'bayer_{p}16': _wide(_bayer(p)) for p in ('rggb', 'bggr', 'gbrg', 'grbg')},
}


def _message(encoding: str, samples: np.ndarray, padding: int = 0) -> Image:
    height, width = samples.shape[:2]
    rows = np.ascontiguousarray(samples).reshape(height, -1).view(np.uint8)
    padded = np.pad(rows, ((0, 0), (0, padding)), constant_values=201)
    msg = Image(height=height, width=width, encoding=encoding, step=padded.shape[1],
                is_bigendian=samples.dtype.str[0] == '>')
    msg.data = data_of(padded)
    return msg


def _assert_shows_the_picture(rgb: np.ndarray, encoding: str) -> None:
    assert rgb.shape == PICTURE.shape and rgb.dtype == np.uint8 and rgb.flags.c_contiguous
    mono = 'mono' in encoding or encoding.endswith('C1')
    expected = np.repeat(GREY[..., None], 3, -1) if mono else PICTURE
    # Luma and colour are rounded to whole numbers on the way: up to 3 of 255.
    tolerance = 3 if SAMPLES[encoding].shape[-1] == 2 else 0
    # A Bayer pixel takes its missing colours from its neighbours: patches are exact inside.
    inside = np.s_[2:-2, [x for x in range(4 * PATCH) if 2 <= x % PATCH < PATCH - 2]]
    difference = rgb[inside].astype(int) - expected[inside]
    assert np.abs(difference).max() <= tolerance


def test_every_encoding_has_a_sample() -> None:
    assert set(SAMPLES) == set(ENCODINGS)


@pytest.mark.parametrize('padding', [0, 6])
@pytest.mark.parametrize('encoding', SAMPLES)
def test_colours_of_every_encoding(encoding: str, padding: int) -> None:
    msg = _message(encoding, SAMPLES[encoding], padding)
    _assert_shows_the_picture(rgb_from_image(over_wire(msg)), encoding)
    _assert_shows_the_picture(rgb_from_image(as_in_bag(msg)), encoding)


@pytest.mark.parametrize('encoding', [name for name in SAMPLES if '16' in name])
def test_big_endian_samples(encoding: str) -> None:
    msg = _message(encoding, SAMPLES[encoding].astype('>u2'))
    _assert_shows_the_picture(rgb_from_image(over_wire(msg)), encoding)


def test_round_trip_of_an_image_is_exact() -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (48, 62, 3), dtype=np.uint8)
    for image in (rgb, rgb[:, ::-1], rgb[::2, ::3]):
        msg = over_wire(image_msg(image, STAMP, 'cam'))
        assert (stamp_ns(msg.header.stamp), msg.header.frame_id) == (STAMP, 'cam')
        np.testing.assert_array_equal(rgb_from_image(msg), image)


def test_an_rgb8_image_is_not_copied() -> None:
    msg = over_wire(image_msg(PICTURE, STAMP, 'cam'))
    assert np.shares_memory(rgb_from_image(msg), np.frombuffer(msg.data, np.uint8))


def test_the_result_can_be_resized_though_its_memory_is_read_only() -> None:
    msg = image_msg(PICTURE, STAMP, 'cam')
    bytes_only = Image(height=msg.height, width=msg.width, step=msg.step, encoding='rgb8')
    bytes_only._data = msg.data.tobytes()
    assert cv2.resize(rgb_from_image(bytes_only), (8, 8)).shape == (8, 8, 3)


def _changed(**fields: Any) -> Image:
    msg = image_msg(PICTURE, STAMP, 'cam')
    for name, value in fields.items():
        setattr(msg, name, value)
    return msg


ROW = 3 * 4 * PATCH
BAD_IMAGES: dict[str, tuple[Image, str]] = {
    'unknown encoding': (_changed(encoding='h264'), 'unknown image encoding .h264.*bayer_rggb8'),
    'no encoding': (_changed(encoding=''), 'unknown image encoding'),
    'a float image': (_changed(encoding='32FC1'), 'unknown image encoding'),
    'no height': (_changed(height=0), 'has no pixels'),
    'no width': (_changed(width=0), 'has no pixels'),
    'an empty message': (Image(encoding='rgb8'), 'has no pixels'),
    'step too small': (_changed(step=ROW - 1), f'step of {ROW - 1} bytes, but a row takes {ROW}'),
    'wrong encoding': (_changed(encoding='rgba8'), 'step'),
    'data cut off': (_changed(data=data_of(PICTURE[:-1])), 'bytes of data, but height x step'),
    'too much data': (_changed(height=PATCH - 1), 'bytes of data, but height x step'),
    'no data': (_changed(data=data_of(PICTURE[:0])), '0 bytes of data'),
    'odd width': (_changed(encoding='yuv422', width=4 * PATCH - 1), 'must be even'),
    'largest sizes': (_changed(height=2**32 - 1, width=2**32 - 1, step=2**32 - 1), 'step'),
}


@pytest.mark.parametrize('read', [over_wire, as_in_bag])
@pytest.mark.parametrize('case', BAD_IMAGES)
def test_a_bad_image_is_named(case: str, read: Callable[[Image], Any]) -> None:
    msg, text = BAD_IMAGES[case]
    with pytest.raises(MessageError, match=text):
        rgb_from_image(read(msg))


@pytest.mark.parametrize('encoding', ENCODINGS)
def test_sizes_of_every_kind_give_an_image_or_a_message_error(encoding: str) -> None:
    for height, width, extra in itertools.product((0, 1, 2, 3), (0, 1, 2, 3), (-1, 0, 5)):
        msg = _changed(encoding=encoding, height=height, width=width)
        msg.step = max(0, width * SAMPLES[encoding][0, 0].nbytes + extra)
        msg.data = data_of(np.zeros(height * msg.step, np.uint8))
        try:
            assert rgb_from_image(msg).shape == (height, width, 3)
        except MessageError:
            continue


def _compressed(suffix: str, image: np.ndarray, kind: str) -> CompressedImage:
    _, data = cv2.imencode(suffix, image)
    return CompressedImage(format=kind, data=data_of(data))


def test_round_trip_of_a_jpeg() -> None:
    msg = over_wire(compressed_msg(PICTURE, STAMP, 'cam', quality=95))
    assert (stamp_ns(msg.header.stamp), msg.header.frame_id) == (STAMP, 'cam')
    rgb = rgb_from_compressed(msg)
    inside = np.s_[4:-4, PATCH // 2::PATCH]
    # JPEG quantises, and halves the resolution of colour: 8 of 255 in the middle of a patch.
    assert np.abs(rgb[inside].astype(int) - PICTURE[inside]).max() <= 8
    np.testing.assert_array_equal(rgb_from_compressed(as_in_bag(msg)), rgb)


@pytest.mark.parametrize('image, kind, expected', [
    (BGR, 'png', PICTURE),
    (BGR, 'rgb8; png compressed bgr8', PICTURE),
    (BGR, 'bgr8; png compressed bgr8', PICTURE),
    (PICTURE, 'bgr8; png compressed rgb8', PICTURE),
    (_with_alpha(BGR), 'bgra8; png compressed ', PICTURE),
    (_wide(BGR).astype(np.uint16), 'bgr16; png compressed bgr16', PICTURE),
    (GREY, 'mono8; png compressed ', GREY[..., None].repeat(3, -1)),
    (_wide(GREY).astype(np.uint16), 'mono16; png compressed ', GREY[..., None].repeat(3, -1)),
])
def test_png_is_exact(image: np.ndarray, kind: str, expected: np.ndarray) -> None:
    rgb = rgb_from_compressed(over_wire(_compressed('.png', image, kind)))
    np.testing.assert_array_equal(rgb, expected)
    assert rgb.flags.c_contiguous


PNG = bytes(_compressed('.png', BGR, 'png').data)


@pytest.mark.parametrize('data, text', [
    (b'', 'has no data'),
    (b'\0', 'cannot be decoded'),
    (b'no image at all', 'cannot be decoded'),
    (PNG[:20], 'cannot be decoded'),
    # A header that claims more pixels than OpenCV takes.
    (PNG[:16] + b'\x7f\xff\xff\xff' * 2 + PNG[24:], 'cannot be decoded'),
])
def test_bad_compressed_data_is_named(data: bytes, text: str) -> None:
    msg = CompressedImage(format='png', data=data)
    with pytest.raises(MessageError, match=text):
        rgb_from_compressed(over_wire(msg))


@pytest.mark.parametrize('image', [
    GREY, PICTURE.astype(np.float32), _with_alpha(PICTURE), PICTURE[:0]])
def test_only_rgb_images_are_sent(image: np.ndarray) -> None:
    for make in (image_msg, compressed_msg):
        with pytest.raises(MessageError, match='must be'):
            make(image, STAMP, 'cam')


def test_encodings_need_no_ros() -> None:
    """Bags are read on machines without it."""
    code = ('import sys, msg_adapters.encodings; '
            "assert not [m for m in sys.modules if m.endswith('_msgs') or m == 'rclpy']")
    subprocess.run([sys.executable, '-c', code], check=True,
                   cwd=Path(__file__).resolve().parents[1])
