"""Every form of dataset, on real recordings where they are there, and on broken input."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from aim_slam_ros.datasets import DatasetError, ImageError, load_sequence

DATA = Path(__file__).resolve().parents[2] / 'shared' / 'data'
CAMERA = 'width = 64\nheight = 48\nfx = 50\nfy = 51\ncx = 31.5\ncy = 23.5\n'
DISTORTION = 'distortion = 0.2 -0.3 0.001 0.002 0.1\n'


def picture(value: int = 0) -> np.ndarray:
    """[48,64,3] uint8 RGB: noise with a red level of its own."""
    image = np.random.default_rng(value).integers(0, 255, (48, 64, 3), dtype=np.uint8)
    image[..., 0] = value
    return image


def save(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image[..., ::-1] if image.ndim == 3 else image)


def tum_folder(folder: Path, stamps: tuple[str, ...] = ('1.0', '1.1', '1.2')) -> Path:
    for i, stamp in enumerate(stamps):
        save(folder / 'rgb' / f'{i}.png', picture(i))
    (folder / 'rgb.txt').write_text('# colour images\n' + ''.join(
        f'{stamp} rgb/{i}.png\n' for i, stamp in enumerate(stamps)))
    return folder


@pytest.mark.parametrize('name, images, depths, poses', [
    ('tum_fr1_xyz', 798, 133, 3000), ('tum_fr1_rpy_300', 300, 50, 2742),
    ('redkitchen_600', 600, 120, 600), ('kitti00_120', 120, 0, 120)])
def test_real_recording(name: str, images: int, depths: int, poses: int) -> None:
    if not (DATA / name).exists():
        pytest.skip(f'{DATA / name} is not there')
    sequence = load_sequence(DATA / name)
    assert (sequence.name, len(sequence)) == (name, images)
    assert sequence.K is not None and sequence.groundtruth is not None
    assert len(sequence.groundtruth) == poses
    assert (np.diff(sequence.stamps_ns) > 0).all()
    image = sequence.image(images - 1)
    assert image.dtype == np.uint8 and image.shape[2] == 3 and image.flags.c_contiguous
    depth = sequence.depth(0)
    assert (depth is not None) == (depths > 0)
    if depth is not None:
        # Indoor recordings of a Kinect: everything is between 0.3 and 10 m.
        assert depth.shape == image.shape[:2] and depth.dtype == np.float32
        assert 0.3 < np.median(depth[depth > 0]) < 10.0


def test_real_undistorted_depth_still_belongs_to_its_image() -> None:
    if not (DATA / 'tum_fr1_xyz').exists():
        pytest.skip(f'{DATA} is not there')
    raw = load_sequence(DATA / 'tum_fr1_xyz')
    flat = load_sequence(DATA / 'tum_fr1_xyz', undistort=True)
    assert raw.distortion is not None and flat.distortion is None
    np.testing.assert_array_equal(raw.K, flat.K)
    expected = cv2.undistort(raw.image(0), raw.K, raw.distortion)
    # cv2.undistort works with fixed-point maps: a few levels at edges, none on average.
    assert np.abs(flat.image(0).astype(int) - expected).mean() < 1.0
    depth = flat.depth(0)
    assert depth is not None and depth.shape == expected.shape[:2] and flat.depth(1) is None


def test_tum_stamps_are_exact_and_nothing_else_is_needed(tmp_path: Path) -> None:
    # float64 seconds of today are 0.2 us coarse; the stamp must survive to the nanosecond.
    stamps = ('1305031102.175304001', '1305031102.211214')
    sequence = load_sequence(tum_folder(tmp_path / 'desk', stamps))
    assert sequence.stamps_ns.tolist() == [1305031102175304001, 1305031102211214000]
    assert sequence.name == 'desk'
    assert sequence.K is None and sequence.distortion is None and sequence.groundtruth is None
    assert sequence.depth(0) is None
    np.testing.assert_array_equal(sequence.image(1), picture(1))


def test_tum_is_put_in_order_and_one_of_two_equal_stamps_is_left_out(
        tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Listed as `ls` does it, 99.9 comes after 100.0."""
    sequence = load_sequence(tum_folder(tmp_path, ('100.0', '100.0', '101.0', '99.9')))
    assert sequence.stamps_ns.tolist() == [99_900_000_000, 10**11, 101 * 10**9]
    assert sequence.dropped_stamps == 1
    for index, listed in enumerate((3, 0, 2)):
        np.testing.assert_array_equal(sequence.image(index), picture(listed))
    assert '1 of the listed images are left out' in caplog.text


def test_tum_counts_torn_lines(tmp_path: Path) -> None:
    folder = tum_folder(tmp_path)
    with (folder / 'rgb.txt').open('a') as file:
        file.write('1.3\nx rgb/0.png\nnan rgb/0.png\n')
    sequence = load_sequence(folder)
    assert (len(sequence), sequence.unreadable_lines) == (3, 3)


def test_tum_groundtruth_is_camera_to_world(tmp_path: Path) -> None:
    folder = tum_folder(tmp_path)
    # A quarter turn about z with a quaternion that is not normalised; then a row without a pose.
    (folder / 'groundtruth.txt').write_text('1.0 1 2 3 0 0 2 2\n1.1 nan 0 0 0 0 0 1\n')
    truth = load_sequence(folder).groundtruth
    assert truth is not None and len(truth) == 1
    moved = truth.T_world_cam[0] @ [1.0, 0.0, 0.0, 1.0]
    np.testing.assert_allclose(moved, [1.0, 3.0, 3.0, 1.0], atol=1e-12)


@pytest.mark.parametrize('listing, text', [
    ('associations.txt', '1.0 rgb/0.png 1.01 depth/0.png\n'),
    ('associations.txt', '1.01 depth/0.png 1.0 rgb/0.png\n'),
    ('depth.txt', '0.9 depth/none.png\n1.01 depth/0.png\n1.15 depth/none.png\n')])
def test_tum_depth(tmp_path: Path, listing: str, text: str) -> None:
    folder = tum_folder(tmp_path)
    save(folder / 'depth' / '0.png', np.full((48, 64), 3000, np.uint16))
    (folder / listing).write_text(text)
    for camera, metres in ((CAMERA, 0.6), (CAMERA + 'depth_scale = 1000\n', 3.0)):
        (folder / 'camera.txt').write_text(camera)
        depth = load_sequence(folder).depth(0)
        assert depth is not None and load_sequence(folder).depth(2) is None
        np.testing.assert_allclose(depth, metres, rtol=1e-6)


def test_undistort(tmp_path: Path) -> None:
    folder = tum_folder(tmp_path)
    with pytest.raises(DatasetError, match='no calibration'):
        load_sequence(folder, undistort=True)
    (folder / 'camera.txt').write_text(CAMERA)
    np.testing.assert_array_equal(load_sequence(folder, undistort=True).image(2), picture(2))
    (folder / 'camera.txt').write_text(CAMERA + DISTORTION)
    flat = load_sequence(folder, undistort=True)
    raw = load_sequence(folder)
    np.testing.assert_array_equal(flat.K, [[50, 0, 31.5], [0, 51, 23.5], [0, 0, 1]])
    assert flat.distortion is None and raw.distortion is not None
    assert raw.distortion.shape == (5,)
    assert (flat.image(0) != raw.image(0)).any()


@pytest.mark.parametrize('text, where', [
    ('fx = 5', 'lacks fy, cx, cy'), ('# c\nfx: 500\n', r'camera.txt:2: "fx: 500"'),
    ('fx = abc\n', 'camera.txt:1'), ('fx = nan\n', 'camera.txt:1'), ('fx = -5\n', 'positive'),
    (CAMERA + 'focus = 3\n', 'camera.txt:7'), (CAMERA + 'distortion = 1 2\n', 'camera.txt:7'),
    (CAMERA.replace('64', '640'), '64x48 pixels, its calibration is for 640x48')])
def test_bad_camera_file_names_its_line(tmp_path: Path, text: str, where: str) -> None:
    folder = tum_folder(tmp_path)
    (folder / 'camera.txt').write_text(text)
    with pytest.raises(DatasetError, match=where):
        load_sequence(folder)


def test_bad_image_is_named_and_the_others_still_come(tmp_path: Path) -> None:
    folder = tum_folder(tmp_path, tuple(f'{i}.0' for i in range(6)))
    save(folder / 'rgb' / 'whole.jpg', picture(9))
    whole = (folder / 'rgb' / 'whole.jpg').read_bytes()
    (folder / 'rgb' / '0.png').unlink()
    (folder / 'rgb' / '1.png').write_bytes(b'')
    (folder / 'rgb' / '2.png').write_bytes(b'this is no image')
    torn = (folder / 'rgb' / '3.png').read_bytes()
    (folder / 'rgb' / '3.png').write_bytes(torn[:len(torn) // 2])
    (folder / 'rgb' / '4.png').write_bytes(whole[:len(whole) // 2])
    sequence = load_sequence(folder)
    for index, reason in enumerate(('No such file', 'empty', 'decoded', 'cut short', 'cut short')):
        with pytest.raises(ImageError, match=reason) as caught:
            sequence.image(index)
        assert caught.value.path == folder / 'rgb' / f'{index}.png'
    np.testing.assert_array_equal(sequence.image(5), picture(5))


def test_grey_and_16_bit_images_come_as_rgb(tmp_path: Path) -> None:
    save(tmp_path / '0.png', picture()[..., 1])
    save(tmp_path / '1.png', picture()[..., 1].astype(np.uint16) * 257)
    sequence = load_sequence(tmp_path)
    for index in range(2):
        np.testing.assert_array_equal(sequence.image(index),
                                      np.repeat(picture()[..., 1:2], 3, 2))


@pytest.mark.parametrize('names, stamps_ns', [
    (('10', '9', '100'), [0, 33333333, 66666667]),
    (('frame10', 'frame9', 'frame100'), [0, 33333333, 66666667]),
    (('10.5', '9.25', '100.0'), [9250000000, 10500000000, 100000000000]),
    (('1403636579763555584', '1403636579663555584'),
     [1403636579663555584, 1403636579763555584])])
def test_folder_is_sorted_by_number(tmp_path: Path, names: tuple[str, ...],
                                    stamps_ns: list[int]) -> None:
    for i, name in enumerate(names):
        save(tmp_path / f'{name}.png', picture(i))
    (tmp_path / 'notes.txt').write_text('not an image')
    sequence = load_sequence(tmp_path)
    assert sequence.stamps_ns.tolist() == stamps_ns
    np.testing.assert_array_equal(sequence.image(0), picture(1))
    np.testing.assert_array_equal(sequence.image(1), picture(0))


def test_a_video_without_a_frame_count_is_counted(tmp_path: Path) -> None:
    """A raw stream of JPEGs has no header that could tell."""
    path = tmp_path / 'camera.mjpeg'
    path.write_bytes(b''.join(cv2.imencode('.jpg', picture(i))[1].tobytes() for i in range(4)))
    sequence = load_sequence(path)
    assert len(sequence) == 4
    assert sequence.image(3).shape == picture(3).shape


def test_names_with_decimals_are_times(tmp_path: Path) -> None:
    for name, stamp_ns in (('12.5', 12_500_000_000), ('1305031102175.304', 1305031102175304000)):
        save(tmp_path / name / f'{name}.png', picture())
        assert load_sequence(tmp_path / name).stamps_ns.tolist() == [stamp_ns]


def test_folder_drops_two_names_of_one_time(tmp_path: Path) -> None:
    for name in ('7.0', '07.0', '8.0'):
        save(tmp_path / f'{name}.png', picture())
    sequence = load_sequence(tmp_path)
    assert (len(sequence), sequence.dropped_stamps) == (2, 1)


def test_video(tmp_path: Path) -> None:
    path = tmp_path / 'walk.avi'
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*'MJPG'), 20.0, (64, 48))
    if not writer.isOpened():
        pytest.skip('this OpenCV writes no MJPG')
    for value in range(0, 250, 25):
        writer.write(np.full((48, 64, 3), (0, 0, value), np.uint8))
    writer.release()
    sequence = load_sequence(path)
    assert (sequence.name, len(sequence)) == ('walk', 10)
    assert sequence.stamps_ns.tolist() == [i * 50_000_000 for i in range(10)]
    # In order, the same again, a jump ahead, and back: MJPG keeps flat colours within 3 levels.
    for index in (0, 1, 1, 7, 2, 9, -1):
        image = sequence.image(index)
        np.testing.assert_allclose(image[20, 30], [25 * (index % 10), 0, 0], atol=3)
    with pytest.raises(IndexError):
        sequence.image(10)


SENSOR = """%YAML:1.0
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [0.0, -1.0, 0.0, 0.1,
         1.0, 0.0, 0.0, 0.2,
         0.0, 0.0, 1.0, 0.3,
         0.0, 0.0, 0.0, 1.0]
resolution: [64, 48]
camera_model: pinhole
intrinsics: [50.0, 51.0, 31.5, 23.5]
distortion_model: radial-tangential
distortion_coefficients: [-0.28, 0.07, 0.0002, 0.00002]
"""


def asl_folder(folder: Path) -> Path:
    cam0 = folder / 'mav0' / 'cam0'
    for stamp in (1403636579763555584, 1403636579813555456):
        save(cam0 / 'data' / f'{stamp}.png', picture()[..., 1])
    (cam0 / 'data.csv').write_text('#timestamp [ns],filename\r\n' + ''.join(
        f'{path.stem},{path.name}\r\n' for path in sorted((cam0 / 'data').iterdir())))
    (cam0 / 'sensor.yaml').write_text(SENSOR)
    truth = folder / 'mav0' / 'state_groundtruth_estimate0' / 'data.csv'
    truth.parent.mkdir()
    # The body at (1, 2, 3), turned half around x: q = (w, x, y, z) = (0, 1, 0, 0).
    truth.write_text('#timestamp, p_RS_R_x [m]\n1403636579763555584,1,2,3,0,1,0,0,0,0,0\n')
    return folder


@pytest.mark.parametrize('inside', ['.', 'mav0', 'mav0/cam0'])
def test_euroc(tmp_path: Path, inside: str) -> None:
    sequence = load_sequence(asl_folder(tmp_path / 'MH_01') / inside)
    assert (sequence.name, len(sequence)) == ('MH_01', 2)
    assert sequence.stamps_ns[0] == 1403636579763555584
    assert sequence.image(1).shape == (48, 64, 3)
    np.testing.assert_array_equal(sequence.distortion, [-0.28, 0.07, 0.0002, 0.00002])
    assert sequence.K is not None and sequence.groundtruth is not None
    np.testing.assert_array_equal(sequence.K[0], [50.0, 0.0, 31.5])
    # The camera sits at (.1, .2, .3) on the body, which the half turn takes to (.1, -.2, -.3);
    # its x axis is the body's y axis, which points to -y.
    T_world_cam = sequence.groundtruth.T_world_cam[0]
    np.testing.assert_allclose(T_world_cam[:3, 3], [1.1, 1.8, 2.7], atol=1e-12)
    np.testing.assert_allclose(T_world_cam[:3, 0], [0.0, -1.0, 0.0], atol=1e-12)


def test_euroc_without_usable_calibration(tmp_path: Path) -> None:
    folder = asl_folder(tmp_path)
    sensor = folder / 'mav0' / 'cam0' / 'sensor.yaml'
    sensor.write_text(SENSOR.replace('radial-tangential', 'equidistant'))
    assert load_sequence(folder).K is None
    with pytest.raises(DatasetError, match='no calibration'):
        load_sequence(folder, undistort=True)
    sensor.write_text('intrinsics: [1, 2]\n')
    with pytest.raises(DatasetError, match='sensor.yaml'):
        load_sequence(folder)
    sensor.unlink()
    with pytest.raises(DatasetError, match='T_BS'):
        load_sequence(folder)


def test_what_is_no_dataset_says_what_was_looked_for(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match='nowhere.*does not exist'):
        load_sequence(tmp_path / 'nowhere')
    with pytest.raises(DatasetError, match='looked for rgb.txt .*mav0/cam0.* and images'):
        load_sequence(tmp_path)
    tum_folder(tmp_path / 'inner')
    with pytest.raises(DatasetError, match='perhaps its inner'):
        load_sequence(tmp_path)
    (tmp_path / 'film.mp4').write_text('this is no video')
    with pytest.raises(DatasetError, match='film.mp4.*not a video'):
        load_sequence(tmp_path / 'film.mp4')
    with pytest.raises(DatasetError, match='single image'):
        load_sequence(tmp_path / 'inner' / 'rgb' / '0.png')


@pytest.mark.parametrize('text, problem', [
    (b'', 'it is empty'), (b'# only a comment\n', 'it is empty'),
    (b'hello world\n1.0\n', 'none of its 2 lines'), (b'\xff\xfe\x00', 'not a text file')])
def test_rgb_list_without_an_image(tmp_path: Path, text: bytes, problem: str) -> None:
    (tmp_path / 'rgb.txt').write_bytes(text)
    with pytest.raises(DatasetError, match=f'rgb.txt.*{problem}'):
        load_sequence(tmp_path)
