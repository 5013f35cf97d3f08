"""Bags as datasets: what is taken from them, and broken ones."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import bag_making as making
import cv2
import numpy as np
import pytest
from bag_making import FIRST_NS, ROS1, ROS2, STEP_NS, picture
from rosbags.rosbag2 import StoragePlugin

from aim_slam_ros.cli import convert, evaluate
from aim_slam_ros.datasets import DatasetError, ImageError, load_sequence
from aim_slam_ros.datasets.rendered import render

K = np.array([[50.0, 0.0, 31.5], [0.0, 51.0, 23.5], [0.0, 0.0, 1.0]])
D = (0.2, -0.3, 0.001, 0.002, 0.1)
QUARTER = (0.0, 0.0, 1.0, 1.0)      # about z, not normalised
STORAGES = {'mcap': StoragePlugin.MCAP, 'db3': StoragePlugin.SQLITE3}


@pytest.fixture(params=['mcap', 'db3'])
def storage(request: pytest.FixtureRequest) -> str:
    return request.param


def everything(store: object, count: int = 4) -> list[making.Record]:
    """Images with camera_info, ground truth, and a topic that is none of these."""
    others = [('/camera/camera_info', FIRST_NS, making.camera_info(K, D, FIRST_NS, store)),
              ('/groundtruth', FIRST_NS, making.transform((1, 2, 3), QUARTER, FIRST_NS, store)),
              ('/where', FIRST_NS, making.transform((9, 9, 9), QUARTER, FIRST_NS, store))]
    return others + making.images(count, '/camera/image_raw', store)


def message_of(path: Path | str) -> str:
    with pytest.raises(DatasetError) as error:
        load_sequence(path)
    return str(error.value)


# What is read.

def test_a_rosbag2_is_read_in_every_shape(tmp_path: Path, storage: str) -> None:
    folder = making.write_ros2(tmp_path / 'walk', everything(ROS2), STORAGES[storage])
    for path in (folder, folder / f'walk.{storage}'):
        check_everything(path)


def test_a_ros1_bag_is_read(tmp_path: Path) -> None:
    check_everything(making.write_ros1(tmp_path / 'walk.bag', everything(ROS1)))


def check_everything(path: Path) -> None:
    sequence = load_sequence(path)
    assert sequence.name == 'walk' and sequence.dropped_stamps == 0
    assert sequence.stamps_ns.tolist() == [FIRST_NS + i * STEP_NS for i in range(4)]
    np.testing.assert_array_equal(sequence.K, K)
    np.testing.assert_array_equal(sequence.distortion, D)
    truth = sequence.groundtruth
    assert truth is not None and truth.stamps_ns.tolist() == [FIRST_NS]
    # Camera-to-world: its x axis points along the world's y.
    np.testing.assert_allclose(truth.T_world_cam[0] @ [1, 0, 0, 1], [1, 3, 3, 1], atol=1e-12)
    for index in (0, 1, 3, 2, 0, -1):       # in order, ahead, and back
        image = sequence.image(index)
        np.testing.assert_array_equal(image, picture(index % 4))
        assert image.flags.writeable and image.flags.c_contiguous
    with pytest.raises(IndexError):
        sequence.image(4)


def test_a_long_bag_is_read_in_any_order(tmp_path: Path, storage: str) -> None:
    """Several chunks of an mcap; jumps that are read over and jumps that are not."""
    count = 90
    path = making.write_ros2(tmp_path / 'bag', making.images(count, size=(96, 128)),
                             STORAGES[storage])
    sequence = load_sequence(path)
    order = np.random.default_rng(0).permutation(count).tolist()
    for index in [*order, *range(count), *range(0, count, 7)]:
        assert sequence.image(index)[0, 0, 0] == index


def test_messages_recorded_at_one_time_are_told_apart(tmp_path: Path, storage: str) -> None:
    records = [(topic, FIRST_NS, message) for topic, _, message in making.images(5)]
    sequence = load_sequence(making.write_ros2(tmp_path / 'bag', records, STORAGES[storage]))
    for index in (3, 1, 4, 0, 2):
        np.testing.assert_array_equal(sequence.image(index), picture(index))


def test_a_message_without_a_stamp_has_that_of_its_recording(tmp_path: Path) -> None:
    records = [('/image', FIRST_NS + i * STEP_NS, making.image(picture(i), 0)) for i in range(3)]
    sequence = load_sequence(making.write_ros2(tmp_path / 'bag', records))
    assert sequence.stamps_ns.tolist() == [FIRST_NS + i * STEP_NS for i in range(3)]


def test_one_message_without_a_stamp_is_left_out(tmp_path: Path) -> None:
    """A simulator's first image, at 0: the time of its recording is that of another clock."""
    records = [('/image', FIRST_NS + i, making.image(picture(i), i * STEP_NS)) for i in range(4)]
    sequence = load_sequence(making.write_ros2(tmp_path / 'bag', records))
    assert sequence.stamps_ns.tolist() == [STEP_NS, 2 * STEP_NS, 3 * STEP_NS]
    assert sequence.unreadable_lines == 1
    np.testing.assert_array_equal(sequence.image(0), picture(1))


def test_stamps_that_are_not_newer_are_dropped_and_counted(tmp_path: Path) -> None:
    stamps = [5, 7, 7, 6, 9]
    records = [('/image', 100 + i, making.image(picture(i), stamp))
               for i, stamp in enumerate(stamps)]
    sequence = load_sequence(making.write_ros2(tmp_path / 'bag', records))
    assert sequence.stamps_ns.tolist() == [5, 7, 9] and sequence.dropped_stamps == 2
    np.testing.assert_array_equal(sequence.image(2), picture(4))


def test_compressed_and_grey_images(tmp_path: Path) -> None:
    png = cv2.imencode('.png', picture(1)[..., ::-1])[1].reshape(-1)
    records = [('/a/image/compressed', 1, making.make(
        ROS2, 'sensor_msgs/msg/CompressedImage', header=making.header(1), format='png', data=png)),
        ('/a/camera_info', 1, making.camera_info(K, D, 1))]
    sequence = load_sequence(making.write_ros2(tmp_path / 'png', records))
    np.testing.assert_array_equal(sequence.image(0), picture(1))
    np.testing.assert_array_equal(sequence.K, K)
    grey = np.ascontiguousarray(picture(2)[..., 1])
    records = [('/image', 1, making.image(grey, 1, 'mono8'))]
    sequence = load_sequence(making.write_ros2(tmp_path / 'grey', records))
    np.testing.assert_array_equal(sequence.image(0), np.repeat(grey[..., None], 3, 2))


# Which topic.

def test_several_image_topics_are_listed_and_one_can_be_chosen(tmp_path: Path) -> None:
    path = making.write_ros2(tmp_path / 'stereo', [
        *making.images(2, '/left/image_raw'), *making.images(3, '/right/image_raw'),
        ('/left/camera_info', FIRST_NS, making.camera_info(K, D, FIRST_NS))])
    message = message_of(path)
    assert '/left/image_raw (2 messages), /right/image_raw (3 messages)' in message
    assert f'{path}?topic=/left/image_raw' in message
    assert len(load_sequence(f'{path}?topic=/right/image_raw')) == 3
    # Calibration is looked for beside the images, or taken from where one says.
    assert load_sequence(f'{path}?topic=right/image_raw').K is None
    both = '?topic=/right/image_raw&camera_info=/left/camera_info'
    np.testing.assert_array_equal(load_sequence(f'{path}{both}').K, K)
    assert load_sequence(f'{path}?topic=/left/image_raw&camera_info=none').K is None
    assert 'has no image topic /up' in message_of(f'{path}?topic=/up')
    assert 'write BAG?topic=TOPIC' in message_of(f'{path}?topik=/up')


@pytest.mark.parametrize('other', ['/left/image_raw', '/image/compressed', '/depth/image'])
def test_the_usual_topic_is_taken_without_asking(tmp_path: Path, other: str) -> None:
    path = making.write_ros2(tmp_path / 'bag',
                             [*making.images(2), *making.images(3, other)])
    assert len(load_sequence(path)) == 2


def test_depth_images_are_no_pictures(tmp_path: Path) -> None:
    path = making.write_ros2(tmp_path / 'bag', [*making.images(2, '/camera/depth/image'),
                                                *making.images(3, '/camera/rgb/image_color')])
    assert len(load_sequence(path)) == 3


def test_an_uncalibrated_camera_or_another_lens_model_gives_no_calibration(tmp_path: Path) -> None:
    for name, info in (('zeros', making.camera_info(np.zeros((3, 3)), (), 1)),
                       ('fisheye', making.camera_info(K, D[:4], 1, model='equidistant'))):
        path = making.write_ros2(tmp_path / name, [*making.images(1), ('/camera_info', 1, info)])
        assert load_sequence(path).calibration is None


def test_a_calibration_that_cannot_be_used_is_refused(tmp_path: Path) -> None:
    wrong = making.camera_info(np.where(K == 50, np.nan, K), D, 1)
    path = making.write_ros2(tmp_path / 'nan', [*making.images(1), ('/camera_info', 1, wrong)])
    message = message_of(path)
    assert 'not finite' in message and '?camera_info=none' in message
    assert load_sequence(f'{path}?camera_info=none').K is None
    path = making.write_ros2(tmp_path / 'size', [*making.images(1, size=(24, 32)), (
        '/camera_info', 1, making.camera_info(K, D, 1))])
    assert '32x24 pixels, their camera_info is for 64x48' in message_of(path)


def test_poses_that_are_none_are_left_out_and_the_rest_is_sorted(tmp_path: Path) -> None:
    nan = float('nan')
    rows = [(30, (3, 0, 0), (0, 0, 0, 1)), (10, (1, 0, 0), (0, 0, 0, 1)),
            (20, (nan, 0, 0), (0, 0, 0, 1)), (25, (0, 0, 0), (0, 0, 0, 0))]
    records = [('/groundtruth', 100 + i, making.transform(p, q, stamp))
               for i, (stamp, p, q) in enumerate(rows)]
    path = making.write_ros2(tmp_path / 'bag', [*making.images(1), *records])
    truth = load_sequence(path).groundtruth
    assert truth is not None and truth.stamps_ns.tolist() == [10, 30]
    assert truth.T_world_cam[:, 0, 3].tolist() == [1, 3]
    path = making.write_ros2(tmp_path / 'none', [*making.images(1), *records[2:]])
    assert '/groundtruth holds no usable pose' in message_of(path)
    assert load_sequence(f'{path}?groundtruth=none').groundtruth is None


def test_rectified_images_have_the_camera_of_p_and_no_distortion(tmp_path: Path) -> None:
    info = making.camera_info(K, D, FIRST_NS)
    info.p = np.hstack([np.diag([0.5, 0.5, 1.0]) @ K, np.zeros((3, 1))]).reshape(-1)
    path = making.write_ros2(tmp_path / 'bag', [
        *making.images(2, '/cam/image_rect_color'), ('/cam/camera_info', FIRST_NS, info)])
    sequence = load_sequence(path)
    np.testing.assert_array_equal(sequence.K, np.diag([0.5, 0.5, 1.0]) @ K)
    assert sequence.distortion is None


# What is broken.

def test_a_damaged_message_is_an_image_that_cannot_be_read(tmp_path: Path) -> None:
    records = making.images(5)
    raw = bytes(ROS2.serialize_cdr(records[1][2], 'sensor_msgs/msg/Image'))
    step = making.image(picture(2), FIRST_NS + 2 * STEP_NS)
    step.step = 7
    records[1] = ('/image', records[1][1], raw[:200])       # cut short
    records[2] = ('/image', records[2][1], step)
    records[3] = ('/image', records[3][1], raw[:6])         # without even a header
    sequence = load_sequence(making.write_ros2(tmp_path / 'bag', records))
    assert len(sequence) == 4 and sequence.unreadable_lines == 1
    for index in (1, 2):
        with pytest.raises(ImageError, match=f'image {index} of /image'):
            sequence.image(index)
    np.testing.assert_array_equal(sequence.image(3), picture(4))


def test_what_is_no_bag_or_holds_no_images_is_refused(tmp_path: Path) -> None:
    assert 'does not exist' in message_of(tmp_path / 'none.mcap')
    pose = ('/pose', 1, making.transform((1, 2, 3), QUARTER, 1))
    message = message_of(making.write_ros2(tmp_path / 'poses', [pose]))
    assert 'holds no images' in message and '/pose' in message
    assert 'a bag without messages' in message_of(making.write_ros2(tmp_path / 'empty', []))
    folder = tmp_path / 'pictures'
    folder.mkdir()
    cv2.imwrite(str(folder / '1.png'), picture(0))
    assert 'is no bag' in message_of(f'{folder}?topic=/image')


def test_a_folder_with_half_of_a_bag_is_told_from_one_with_none(tmp_path: Path) -> None:
    folder = making.write_ros2(tmp_path / 'bag', making.images(1))
    (folder / 'bag.mcap').unlink()
    assert 'bag.mcap' in message_of(folder) and 'cannot be read' in message_of(folder)
    # Other things have a metadata.yaml too, and bags are looked for below.
    (folder / 'metadata.yaml').write_text('author: somebody\n')
    making.write_ros2(folder / 'inner', making.images(1))
    assert 'is no dataset' in message_of(folder) and 'perhaps its inner' in message_of(folder)


def test_a_bag_whose_recorder_was_killed_is_refused_with_the_remedy(
        tmp_path: Path, storage: str) -> None:
    folder = making.write_ros2(tmp_path / 'bag', making.images(40), STORAGES[storage])
    whole = folder / f'bag.{storage}'
    data = whole.read_bytes()
    (folder / 'metadata.yaml').unlink()
    message = message_of(folder)
    assert 'ros2 bag reindex' in message and whole.name in message
    assert len(load_sequence(whole)) == 40
    whole.write_bytes(data[:len(data) // 2])
    message = message_of(whole)
    assert 'cannot be read' in message and 'repair it with' in message


@pytest.mark.parametrize('name', ['bag.mcap', 'bag.db3', 'bag.bag'])
def test_damage_anywhere_is_told_not_a_crash(tmp_path: Path, name: str) -> None:
    """Files cut anywhere, and with bytes changed anywhere."""
    if name == 'bag.bag':
        path = making.write_ros1(tmp_path / name, making.images(3, store=ROS1))
    else:
        making.write_ros2(tmp_path / 'bag', making.images(3), STORAGES[name[4:]])
        path = tmp_path / 'bag' / name
    data, rng = path.read_bytes(), np.random.default_rng(0)
    for length in [0, 1, 8, 9, *rng.integers(10, len(data), 30).tolist()]:
        read_what_there_is(path, data[:length])
    for _ in range(60):
        damaged = bytearray(data)
        at = int(rng.integers(0, len(data) - 8))
        damaged[at:at + 8] = rng.bytes(8)
        read_what_there_is(path, bytes(damaged))


def read_what_there_is(path: Path, data: bytes) -> None:
    path.write_bytes(data)
    try:
        sequence = load_sequence(path)
    except DatasetError as error:
        assert str(path) in str(error)
        return
    for index in range(len(sequence)):
        try:
            assert sequence.image(index).dtype == np.uint8
        except ImageError:
            pass


def test_evaluate_takes_a_bag(tmp_path: Path) -> None:
    render('room', tmp_path / 'room', frames=slice(0, 40, 2), size=(320, 240))
    assert convert.main([str(tmp_path / 'room'), str(tmp_path / 'bag')]) == 0
    shutil.rmtree(tmp_path / 'room')
    out = tmp_path / 'out'
    arguments = [str(tmp_path / 'bag'), '--out', str(out), '--set', 'camera.width=280']
    assert evaluate.main(arguments) == 0
    figures = json.loads((out / 'metrics.json').read_text(encoding='utf-8'))
    assert figures['frames_offered'] == 20 and figures['dataset'] == 'bag'
    assert figures['frames_unreadable'] == 0
