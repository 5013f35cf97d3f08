"""Rendered scenes with exact depth and ground truth, as TUM RGB-D folders in a cache.

``rendered:room`` and ``rendered:corridor``, with ``?seed=N`` for another one of the kind.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
import zlib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Callable
from urllib.parse import parse_qsl

import cv2
import numpy as np
from tqdm import tqdm

from aim_slam_ros.datasets.base import DatasetError, Sequence
from aim_slam_ros.datasets.calibration import TUM_DEPTH_SCALE
from aim_slam_ros.datasets.corridor import corridor
from aim_slam_ros.datasets.motion import wander
from aim_slam_ros.datasets.raycast import render_view
from aim_slam_ros.datasets.room import room
from aim_slam_ros.datasets.scene import Scene
from aim_slam_ros.datasets.text import seconds_from_ns, write_tum_trajectory
from aim_slam_ros.datasets.tum import TumSequence
from aim_slam_ros.geometry import camera
from aim_slam_ros.types import StampedPoses

PREFIX = 'rendered:'
SCENES: dict[str, Callable[[np.random.Generator], Scene]] = {'room': room, 'corridor': corridor}
SIZE = (640, 480)
# Part of the cache's folder name: count up when a scene or its rendering changes.
_VERSION = 1
_FOCAL_PX = 525.0
_NOISE = 2.0
_EXPOSURE = 0.03
_JPEG_QUALITY = 95
# Each holds about 150 MB while it works.
_MAX_WORKERS = 8

Progress = Callable[[int], object]


@dataclass(frozen=True)
class _Camera:
    """How the frames are taken. gains: [N], the exposure of each frame of the scene."""

    K: np.ndarray
    size: tuple[int, int]
    seed: int
    gains: np.ndarray


def load_rendered(source: str, cache_dir: Path | None) -> Sequence:
    """The scene from the cache, rendered first where it is not there; raises DatasetError."""
    name, seed = _parsed(source)
    folder = cache_folder(name, seed, cache_dir)
    if not (folder / 'rgb.txt').exists():
        try:
            _fill_cache(name, seed, folder)
        except OSError as error:
            raise DatasetError(folder, f'cannot be written ({error.strerror})', 'name another '
                               'cache directory, e.g. in XDG_CACHE_HOME, or free space') from error
    sequence = TumSequence(folder)
    sequence.name = f'rendered_{name}' + (f'_{seed}' if seed else '')
    return sequence


def cache_folder(name: str, seed: int, cache_dir: Path | None = None) -> Path:
    """Where a scene is kept; by default in the user's cache."""
    return (cache_dir or user_cache()) / f'rendered-{_VERSION}-{name}-{seed}'


def user_cache() -> Path:
    """Where this package keeps what it can make again; not made here."""
    user = os.environ.get('XDG_CACHE_HOME') or '~/.cache'
    return Path(user).expanduser() / 'aim_slam_ros'


def render(name: str, out: Path, *, seed: int = 0, frames: slice = slice(None),
           size: tuple[int, int] = SIZE, progress: Progress | None = None) -> None:
    """Write a scene as a TUM RGB-D folder; raises OSError.

    frames: which frames of the path. size: (W, H); the field of view scales with it, the frames
    are otherwise the same. progress: called with 1 after each frame.
    """
    # crc32, since hash() of a str differs from run to run.
    scene = SCENES[name](np.random.default_rng([seed, zlib.crc32(name.encode())]))
    chosen = range(len(scene.stamps_ns))[frames]
    taken = _camera(scene, seed, size)
    for kind in ('rgb', 'depth'):
        (out / kind).mkdir(parents=True)
    workers = min(os.cpu_count() or 1, _MAX_WORKERS)
    with ThreadPoolExecutor(workers) as pool:
        # In small batches, so that an interrupt does not wait for all of them.
        for start in range(0, len(chosen), workers):
            batch = chosen[start:start + workers]
            for _ in pool.map(lambda index: _write_frame(scene, taken, index, out), batch):
                if progress is not None:
                    progress(1)
    _write_lists(scene, chosen, taken, out)


def _parsed(source: str) -> tuple[str, int]:
    """'rendered:room?seed=3' to ('room', 3)."""
    name, _, query = source.removeprefix(PREFIX).partition('?')
    options = dict(parse_qsl(query, keep_blank_values=True))
    seed = options.pop('seed', '0')
    if name not in SCENES or options or not seed.isdecimal():
        raise DatasetError(source, 'is no rendered scene',
                           'write ' + ' or '.join(PREFIX + scene for scene in SCENES)
                           + ', with ?seed=N (a whole number) if wanted')
    return name, int(seed)


def _fill_cache(name: str, seed: int, folder: Path) -> None:
    """Render aside and rename, so that nobody ever sees half a scene."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    started = time.monotonic()
    with tempfile.TemporaryDirectory(prefix='.rendering-', dir=folder.parent) as aside, \
            tqdm(desc=f'rendering {name}, once', unit=' frames', disable=None) as bar:
        made = Path(aside) / folder.name
        render(name, made, seed=seed, progress=bar.update)
        try:
            made.rename(folder)
        except OSError:
            # Somebody else was faster with the same scene.
            if not (folder / 'rgb.txt').exists():
                raise
    print(f'{PREFIX}{name} rendered in {time.monotonic() - started:.0f} s, kept in {folder}',
          file=sys.stderr)


def _camera(scene: Scene, seed: int, size: tuple[int, int]) -> _Camera:
    full = camera.intrinsics(_FOCAL_PX, _FOCAL_PX, (SIZE[0] - 1) / 2.0, (SIZE[1] - 1) / 2.0)
    K = camera.scaled(full, size[0] / SIZE[0], size[1] / SIZE[1]).numpy()
    rng = np.random.default_rng([seed, len(scene.stamps_ns)])
    gains = 1.0 + _EXPOSURE * wander(rng, scene.stamps_ns / 1e9, 1, 1.0)[:, 0]
    return _Camera(K, size, seed, gains)


def _write_frame(scene: Scene, taken: _Camera, index: int, out: Path) -> None:
    view = render_view(scene, scene.T_world_cam[index], taken.K, taken.size)
    rng = np.random.default_rng([taken.seed, index])
    noisy = view.image * np.float32(taken.gains[index])
    noisy += _NOISE * rng.standard_normal(noisy.shape, dtype=np.float32)
    bgr = np.clip(noisy + 0.5, 0.0, 255.0).astype(np.uint8)[..., ::-1]
    _write(out / _file('rgb', index), bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    depth = np.round(view.depth * TUM_DEPTH_SCALE).astype(np.uint16)
    _write(out / _file('depth', index), depth, [cv2.IMWRITE_PNG_COMPRESSION, 1])


def _file(kind: str, index: int) -> str:
    return f'{kind}/{index:06d}.{"jpg" if kind == "rgb" else "png"}'


def _write(path: Path, image: np.ndarray, options: list[int]) -> None:
    """imwrite would report a full disk as False."""
    path.write_bytes(cv2.imencode(path.suffix, image, options)[1].tobytes())


def _write_lists(scene: Scene, chosen: range, taken: _Camera, out: Path) -> None:
    """The text files, rgb.txt last: it is what makes the folder a dataset."""
    indices = list(chosen)
    write_tum_trajectory(out / 'groundtruth.txt', StampedPoses(
        scene.stamps_ns[indices], scene.T_world_cam[indices]))
    K = taken.K
    (out / 'camera.txt').write_text(
        f'width = {taken.size[0]}\nheight = {taken.size[1]}\nfx = {K[0, 0]}\nfy = {K[1, 1]}\n'
        f'cx = {K[0, 2]}\ncy = {K[1, 2]}\ndepth_scale = {TUM_DEPTH_SCALE}\n')
    stamps = [seconds_from_ns(stamp) for stamp in scene.stamps_ns[indices].tolist()]
    rgb = [f'{stamp} {_file("rgb", index)}' for stamp, index in zip(stamps, indices)]
    depth = [f'{stamp} {_file("depth", index)}' for stamp, index in zip(stamps, indices)]
    (out / 'associations.txt').write_text(
        ''.join(f'{first} {second}\n' for first, second in zip(rgb, depth)))
    (out / 'rgb.txt').write_text(''.join(f'{line}\n' for line in rgb))
