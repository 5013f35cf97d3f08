"""Datasets, videos and ROS 1 bags as rosbag2: what comes back, and what is refused."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import bag_making as making
import cv2
import numpy as np
import pytest
from bag_making import FIRST_NS, ROS1, picture
from rosbags.highlevel import AnyReader

from aim_slam_ros.cli.convert import main
from aim_slam_ros.datasets import Sequence, load_sequence
from aim_slam_ros.datasets.rendered import render
from aim_slam_ros.datasets.text import seconds_from_ns

ROOT = Path(__file__).resolve().parents[1]
SECOND_NS = 10**9
CAMERA = 'width = 64\nheight = 48\nfx = 50\nfy = 51\ncx = 31.5\ncy = 23.5\n'
COUNT = 12


@pytest.fixture(scope='module')
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A few images of the rendered room, with calibration and ground truth."""
    folder = tmp_path_factory.mktemp('data') / 'room'
    render('room', folder, frames=slice(0, 3 * COUNT, 3), size=(160, 120))
    return folder


def tum_folder(folder: Path, count: int = 5, first_ns: int = FIRST_NS) -> Path:
    """Pictures at 10 Hz, and a pose every 0.3 s from 3 s before to 3 s after them."""
    (folder / 'rgb').mkdir(parents=True)
    stamps = [first_ns + i * making.STEP_NS for i in range(count)]
    for i in range(count):
        cv2.imwrite(str(folder / 'rgb' / f'{i}.png'), picture(i)[..., ::-1])
    (folder / 'rgb.txt').write_text(''.join(
        f'{seconds_from_ns(stamp)} rgb/{i}.png\n' for i, stamp in enumerate(stamps)))
    poses = range(max(first_ns - 3 * SECOND_NS, 0), stamps[-1] + 3 * SECOND_NS, 3 * 10**8)
    (folder / 'groundtruth.txt').write_text(''.join(
        f'{seconds_from_ns(stamp)} {i} 2 3 0 0 0 1\n' for i, stamp in enumerate(poses)))
    (folder / 'camera.txt').write_text(CAMERA + 'distortion = 0.2 -0.3 0.001 0.002 0.1\n')
    return folder


def records_of(bag: Path) -> list[tuple[str, str, int, int]]:
    """Topic, type, log time and header stamp of every message, as they come."""
    found = []
    with AnyReader([bag]) as reader:
        for connection, log_ns, raw in reader.messages():
            header = getattr(reader.deserialize(raw, connection.msgtype), 'header')
            stamp = header.stamp.sec * SECOND_NS + header.stamp.nanosec
            found.append((connection.topic, connection.msgtype, log_ns, stamp))
    return found


def assert_same_images(ours: Sequence, theirs: Sequence, indices: range,
                       shift_ns: int = 0) -> None:
    assert (ours.stamps_ns - shift_ns).tolist() == theirs.stamps_ns[list(indices)].tolist()
    for i, index in enumerate(indices):
        np.testing.assert_array_equal(ours.image(i), theirs.image(index))


@pytest.mark.parametrize('storage, suffix', [('mcap', '.mcap'), ('sqlite3', '.db3')])
def test_a_dataset_comes_back_as_it_was(room: Path, tmp_path: Path, storage: str, suffix: str,
                                        capsys: pytest.CaptureFixture[str]) -> None:
    bag = tmp_path / 'bags' / 'room'
    assert main([str(room), str(bag), '--storage', storage]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == str(bag)
    assert {path.name for path in bag.iterdir()} == {'metadata.yaml', f'room{suffix}'}
    assert [path.name for path in bag.parent.iterdir()] == ['room']
    before, after = load_sequence(room), load_sequence(bag)
    # The scene begins at time 0, which is none in ROS: a clock that stands there does not run.
    assert before.stamps_ns[0] == 0
    assert_same_images(after, before, range(COUNT), SECOND_NS)
    np.testing.assert_array_equal(after.K, before.K)
    assert after.distortion is None
    truth, back = before.groundtruth, after.groundtruth
    assert truth is not None and back is not None
    assert (back.stamps_ns - SECOND_NS).tolist() == truth.stamps_ns.tolist()
    # By way of a quaternion: rounding of float64.
    np.testing.assert_allclose(back.T_world_cam, truth.T_world_cam, atol=1e-12)


def test_the_messages_are_in_time_order_at_the_times_of_their_stamps(tmp_path: Path) -> None:
    bag = tmp_path / 'bag'
    folder = tum_folder(tmp_path / 'tum')
    assert main([str(folder), str(bag)]) == 0
    records = records_of(bag)
    assert {(topic, msgtype) for topic, msgtype, _, _ in records} == {
        ('/image', 'sensor_msgs/msg/Image'), ('/camera_info', 'sensor_msgs/msg/CameraInfo'),
        ('/groundtruth', 'geometry_msgs/msg/PoseStamped')}
    times = [log_ns for _, _, log_ns, _ in records]
    assert times == sorted(times) == [stamp for _, _, _, stamp in records]
    # camera_info comes before its image.
    topics = [topic for topic, _, _, _ in records if topic != '/groundtruth']
    assert topics == ['/camera_info', '/image'] * 5
    poses = [stamp for topic, _, stamp, _ in records if topic == '/groundtruth']
    last_ns = FIRST_NS + 4 * making.STEP_NS
    assert FIRST_NS - SECOND_NS <= poses[0] < FIRST_NS - SECOND_NS + 3 * 10**8
    assert last_ns + SECOND_NS - 3 * 10**8 < poses[-1] <= last_ns + SECOND_NS


def test_some_of_the_images_under_another_name(tmp_path: Path) -> None:
    folder, bag = tum_folder(tmp_path / 'tum'), tmp_path / 'bag'
    assert main([str(folder), str(bag), '--start', '1', '--count', '4', '--stride', '2',
                 '--image-topic', 'left/image_raw']) == 0
    assert {topic for topic, *_ in records_of(bag)} == {
        '/left/image_raw', '/left/camera_info', '/groundtruth'}
    before, after = load_sequence(folder), load_sequence(bag)
    assert_same_images(after, before, range(1, 5, 2))
    np.testing.assert_array_equal(after.distortion, before.distortion)


def test_undistorted(tmp_path: Path) -> None:
    folder, bag = tum_folder(tmp_path / 'tum'), tmp_path / 'bag'
    assert main([str(folder), str(bag), '--undistort']) == 0
    after = load_sequence(bag)
    assert after.distortion is None and after.K is not None
    assert_same_images(after, load_sequence(folder, undistort=True), range(5))


def test_compressed(room: Path, tmp_path: Path) -> None:
    bags = {name: tmp_path / name for name in ('raw', 'jpeg')}
    assert main([str(room), str(bags['raw'])]) == 0
    assert main([str(room), str(bags['jpeg']), '--compressed']) == 0
    assert '/image/compressed' in {topic for topic, *_ in records_of(bags['jpeg'])}
    before, after = load_sequence(room), load_sequence(bags['jpeg'])
    assert after.K is not None
    # JPEG at quality 95 changes about as much as the camera's noise of 2 levels.
    difference = np.abs(before.image(0).astype(int) - after.image(0))
    assert difference.mean() < 3.0
    sizes = {name: sum(file.stat().st_size for file in bag.iterdir())
             for name, bag in bags.items()}
    assert sizes['jpeg'] < sizes['raw'] / 2


def test_grey_images_stay_grey(tmp_path: Path) -> None:
    folder, bag = tmp_path / 'grey', tmp_path / 'bag'
    folder.mkdir()
    cv2.imwrite(str(folder / '1.0.png'), picture(1)[..., 1])
    cv2.imwrite(str(folder / '2.0.png'), picture(2)[..., 1])
    assert main([str(folder), str(bag)]) == 0
    with AnyReader([bag]) as reader:
        messages = [reader.deserialize(raw, connection.msgtype)
                    for connection, _, raw in reader.messages()]
    assert [getattr(message, 'encoding') for message in messages] == ['mono8', 'mono8']
    assert_same_images(load_sequence(bag), load_sequence(folder), range(2))


def test_a_ros1_bag_becomes_a_rosbag2(tmp_path: Path) -> None:
    both = [*making.images(3, '/left', ROS1), *making.images(4, '/right', ROS1)]
    source, bag = making.write_ros1(tmp_path / 'old.bag', both), tmp_path / 'new'
    assert main([str(source), str(bag), '--topic', '/right']) == 0
    assert_same_images(load_sequence(bag), load_sequence(f'{source}?topic=/right'), range(4))
    assert load_sequence(bag).K is None


def test_a_video_begins_at_one_second(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    video, bag = tmp_path / 'film.avi', tmp_path / 'bag'
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*'MJPG'), 10.0, (64, 48))
    for i in range(5):
        writer.write(picture(i))
    writer.release()
    assert main([str(video), str(bag)]) == 0
    assert 'all stamps moved by 1 s' in capsys.readouterr().out
    assert_same_images(load_sequence(bag), load_sequence(video), range(5), SECOND_NS)


def test_ground_truth_moves_with_the_images(tmp_path: Path) -> None:
    folder, bag = tum_folder(tmp_path / 'tum', first_ns=0), tmp_path / 'bag'
    assert main([str(folder), str(bag)]) == 0
    after = load_sequence(bag)
    assert after.stamps_ns[0] == SECOND_NS and after.groundtruth is not None
    assert after.groundtruth.stamps_ns[0] == SECOND_NS


def test_images_that_cannot_be_read_are_left_out_and_named(
        tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, bag = tum_folder(tmp_path / 'tum'), tmp_path / 'bag'
    (folder / 'rgb' / '2.png').write_bytes(b'')
    assert main([str(folder), str(bag)]) == 0
    said = capsys.readouterr().out
    assert '2.png: the file is empty' in said and '4 images' in said
    assert len(load_sequence(bag)) == 4
    for path in (folder / 'rgb').iterdir():
        path.write_bytes(b'')
    assert main([str(folder), str(tmp_path / 'none')]) == 2
    assert 'has no readable image' in capsys.readouterr().err
    assert not (tmp_path / 'none').exists()


# What is refused.

@pytest.mark.parametrize('arguments, expected', [
    (['--storage', 'zip'], "'mcap', 'sqlite3'"),
    (['--stride', '0'], 'at least 1'),
    (['--start', '5'], '5 images, 0 to 4'),
    (['--image-topic', 'a b'], 'expected a topic'),
    (['--image-topic', 'groundtruth'], 'expected a topic'),
    (['--topic', '/image'], 'is no bag'),
])
def test_a_wrong_option_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str],
                                   arguments: list[str], expected: str) -> None:
    folder, bag = tum_folder(tmp_path / 'tum'), tmp_path / 'bag'
    assert main([str(folder), str(bag), *arguments]) == 2
    assert expected in capsys.readouterr().err
    assert not bag.exists()


def test_a_source_that_is_none_is_refused(tmp_path: Path,
                                          capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(tmp_path / 'nothing'), str(tmp_path / 'bag')]) == 2
    assert 'does not exist' in capsys.readouterr().err


def test_what_exists_is_only_replaced_on_demand_and_where_it_is_a_bag(
        tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, bag = tum_folder(tmp_path / 'tum'), tmp_path / 'bag'
    assert main([str(folder), str(bag)]) == 0
    assert main([str(folder), str(bag), '--count', '2']) == 2
    assert '--force' in capsys.readouterr().err and len(load_sequence(bag)) == 5
    assert main([str(folder), str(bag), '--count', '2', '--force']) == 0
    assert len(load_sequence(bag)) == 2
    # Even from itself.
    assert main([str(bag), str(bag), '--count', '1', '--force']) == 0
    assert len(load_sequence(bag)) == 1
    (bag / 'notes.txt').write_text('not to be lost')
    assert main([str(folder), str(bag), '--force']) == 2
    assert main([str(folder), str(folder), '--force']) == 2
    assert (bag / 'notes.txt').exists() and (folder / 'rgb.txt').exists()
    capsys.readouterr()
    (tmp_path / 'file').write_text('')
    assert main([str(folder), str(tmp_path / 'file' / 'bag')]) == 2
    assert 'cannot be written' in capsys.readouterr().err


def test_an_interrupted_bag_is_not_left_behind(room: Path, tmp_path: Path) -> None:
    """Ctrl-C twice, while it writes: a bag of the same folder's images, repeated for long."""
    lines = (room / 'rgb.txt').read_text().split()
    for path in ('rgb', 'camera.txt'):
        (tmp_path / path).symlink_to(room / path)
    (tmp_path / 'rgb.txt').write_text(''.join(
        f'{i}.0 {lines[1]}\n' for i in range(1, 100_000)))
    out = tmp_path / 'out' / 'bag'
    process = subprocess.Popen(
        [sys.executable, '-m', 'aim_slam_ros.cli.convert', str(tmp_path), str(out)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env=os.environ | {'PYTHONPATH': str(ROOT)})
    deadline = time.monotonic() + 30.0
    # Under way: rosbags compiles its serialisers first, and Python itself dies of a signal there
    # (a status of -2, for a shell the same 130).
    while not any(path.stat().st_size > 10**6 for path in out.parent.glob('.writing-*/bag/*')):
        assert time.monotonic() < deadline and process.poll() is None
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    process.send_signal(signal.SIGINT)
    said = process.communicate(timeout=3.0)
    assert process.returncode == 130
    assert 'interrupted, nothing is written' in said[1] and 'Traceback' not in said[1]
    assert list(out.parent.iterdir()) == []
