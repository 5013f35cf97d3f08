"""The rendered scenes: geometrically exact, repeatable, textured, and with an honest loop."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest

from aim_slam_ros.datasets import DatasetError, Sequence, load_sequence, rendered
from aim_slam_ros.datasets.corridor import corridor
from aim_slam_ros.datasets.raycast import View, render_view
from aim_slam_ros.datasets.scene import Scene

SIZE = (320, 240)
FRAMES = slice(0, 25, 8)


@dataclass(frozen=True)
class Exact:
    """K: [3,3]. T_world_cam: [N,4,4]. depths: N times [H,W], metres."""

    K: np.ndarray
    T_world_cam: np.ndarray
    depths: list[np.ndarray]


@pytest.fixture(scope='module')
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache that holds the first frames of the room, small."""
    root = tmp_path_factory.mktemp('cache')
    rendered.render('room', rendered.cache_folder('room', 0, root), frames=FRAMES, size=SIZE)
    return root


@pytest.fixture(scope='module')
def room(cache: Path) -> Sequence:
    return load_sequence('rendered:room', cache_dir=cache)


@pytest.fixture(scope='module')
def corridor_scene() -> Scene:
    return corridor(np.random.default_rng(0))


def pinhole(size: tuple[int, int]) -> np.ndarray:
    """The K of the rendered camera at another size."""
    focal = 525.0 * size[0] / 640.0
    return np.array([[focal, 0.0, (size[0] - 1) / 2.0], [0.0, focal, (size[1] - 1) / 2.0],
                     [0.0, 0.0, 1.0]])


def small_view(scene: Scene, index: int) -> View:
    return render_view(scene, scene.T_world_cam[index], pinhole((80, 60)), (80, 60))


def exact(sequence: Sequence) -> Exact:
    """The sequence's K, poses and depths, none of which a rendered sequence may lack."""
    depths = [sequence.depth(index) for index in range(len(sequence))]
    assert sequence.K is not None and sequence.groundtruth is not None
    return Exact(sequence.K, sequence.groundtruth.T_world_cam,
                 [depth for depth in depths if depth is not None])


def seen_from(depth: np.ndarray, K: np.ndarray, T_other_cam: np.ndarray) -> np.ndarray:
    """[3,H*W]: pixel u, v and depth in the other camera of every pixel of this one."""
    h, w = depth.shape
    v, u = np.mgrid[:h, :w].reshape(2, -1)
    points = np.linalg.inv(K) @ np.stack([u, v, np.ones(h * w)]) * depth.ravel()
    moved = T_other_cam[:3, :3] @ points + T_other_cam[:3, 3:]
    return np.concatenate([(K @ moved)[:2] / moved[2], moved[2:]])


def within(uvz: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """[n] bool: which of these points lie in the image."""
    h, w = depth.shape
    return ((uvz[2] > 0.0) & (uvz[0] > 0.0) & (uvz[0] < w - 1)
            & (uvz[1] > 0.0) & (uvz[1] < h - 1))


def agreement(uvz: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """[n] bool: which of these points the camera with this depth image sees."""
    inside = within(uvz, depth)
    u, v = np.where(inside, np.round(uvz[:2]), 0).astype(int)
    return inside & (np.abs(uvz[2] / depth[v, u] - 1.0) < 0.02)


def test_room_is_a_complete_sequence(room: Sequence) -> None:
    assert room.name == 'rendered_room' and len(room) == 4
    known = exact(room)
    np.testing.assert_allclose(known.K, pinhole(SIZE))
    assert room.distortion is None and room.groundtruth is not None
    np.testing.assert_array_equal(room.groundtruth.stamps_ns, room.stamps_ns)
    assert room.image(0).shape == (240, 320, 3)
    # In a room of 5 x 4 x 2.7 m, never nearer than an arm's length to anything.
    assert len(known.depths) == 4
    assert 0.3 < known.depths[0].min() and known.depths[0].max() < 6.5


@pytest.mark.parametrize('other', [1, 3])
def test_depth_and_poses_predict_the_other_image(room: Sequence, other: int) -> None:
    known = exact(room)
    T_other_cam = np.linalg.inv(known.T_world_cam[other]) @ known.T_world_cam[0]
    uvz = seen_from(known.depths[0], known.K, T_other_cam)
    seen = agreement(uvz, known.depths[other])
    # What is in the other image is seen there, but for the little that is hidden.
    assert seen.sum() > 0.9 * within(uvz, known.depths[other]).sum() > 0.5 * seen.size
    grey = [cv2.cvtColor(room.image(i), cv2.COLOR_RGB2GRAY).astype(np.float32)
            for i in (0, other)]
    maps = uvz[:2].reshape(2, *SIZE[::-1]).astype(np.float32)
    here, there = grey[0].ravel()[seen], cv2.remap(grey[1], *maps, cv2.INTER_LINEAR).ravel()[seen]
    error = np.median(np.abs(here - there * here.mean() / there.mean()))
    unaligned = np.median(np.abs(here - grey[1].ravel()[seen]))
    # Noise of 2 levels in both, interpolation and JPEG; unaligned images differ by their contrast.
    assert error < 7.0 and error < 0.35 * unaligned


def test_same_seed_same_bytes_whatever_frames_are_asked_for(cache: Path, tmp_path: Path) -> None:
    rendered.render('room', tmp_path / 'again', frames=slice(16, 17), size=SIZE)
    for file in ('rgb/000016.jpg', 'depth/000016.png'):
        first = rendered.cache_folder('room', 0, cache) / file
        assert (tmp_path / 'again' / file).read_bytes() == first.read_bytes()


def test_corridor_is_long_and_its_start_is_seen_again_only_at_its_end(
        corridor_scene: Scene) -> None:
    T = corridor_scene.T_world_cam
    position = T[:, :3, 3]
    assert np.linalg.norm(np.diff(position[:, :2], axis=0), axis=1).sum() >= 25.0
    # It ends past its start, on the same line of walking, looking the same way.
    past = T[0, :3, :3].T @ (position[-1] - position[0])
    assert 1.5 < past[2] < 3.5 and abs(past[0]) < 0.2
    assert T[0, :3, 2] @ T[-1, :3, 2] > np.cos(np.radians(10.0))
    first = small_view(corridor_scene, 0).depth
    overlap = []
    for index in range(0, len(T), 8):
        T_cam_first = np.linalg.inv(T[index]) @ T[0]
        uvz = seen_from(first, pinhole((80, 60)), T_cam_first)
        overlap.append(agreement(uvz, small_view(corridor_scene, index).depth).mean())
    count = len(overlap)
    assert max(overlap[int(0.35 * count):int(0.85 * count)]) < 0.01
    assert max(overlap[int(0.9 * count):]) > 0.7


def test_motion_can_be_followed(corridor_scene: Scene) -> None:
    T = corridor_scene.T_world_cam
    cosine = (np.einsum('nij,nij->n', T[1:, :3, :3], T[:-1, :3, :3]) - 1.0) / 2.0
    turn_deg_s = np.degrees(np.arccos(cosine)) * 15.0
    # A walking person's head, with the hand's shake; and always some translation.
    assert turn_deg_s.max() < 50.0
    assert np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1).min() > 0.02


@pytest.mark.parametrize('place', [0.0, 0.2, 0.42, 0.65, 0.9])
def test_every_place_has_texture(corridor_scene: Scene, place: float) -> None:
    index = int(place * len(corridor_scene.stamps_ns))
    view = render_view(corridor_scene, corridor_scene.T_world_cam[index], pinhole((640, 480)),
                       (640, 480))
    grey = cv2.resize(cv2.cvtColor(view.image, cv2.COLOR_RGB2GRAY), (259, 196),
                      interpolation=cv2.INTER_AREA)
    assert len(cv2.SIFT_create(800).detect(grey, None)) > 500


def test_interrupted_rendering_leaves_nothing(tmp_path: Path,
                                              monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(name: str, out: Path, **_: object) -> None:
        (out / 'rgb').mkdir(parents=True)
        raise KeyboardInterrupt
    monkeypatch.setattr(rendered, 'render', interrupted)
    with pytest.raises(KeyboardInterrupt):
        load_sequence('rendered:room', cache_dir=tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_unwritable_cache_is_named(tmp_path: Path) -> None:
    (tmp_path / 'file').write_text('in the way')
    with pytest.raises(DatasetError, match='file.*XDG_CACHE_HOME'):
        load_sequence('rendered:room', cache_dir=tmp_path / 'file')


@pytest.mark.parametrize('source', ['rendered:', 'rendered:garden', 'rendered:room?seed=x',
                                    'rendered:room?speed=1'])
def test_unknown_scene_names_the_known_ones(source: str) -> None:
    with pytest.raises(DatasetError, match='rendered:room or rendered:corridor'):
        load_sequence(source)
