"""What ~/save_map leaves on the disk."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import numpy as np
import torch

from msg_adapters.poses import T_ZUP_OPTICAL

from ...config import Config
from ...datasets.text import write_tum_trajectory
from ...evaluation.reconstruction import write_ply
from ...geometry import sim3
from ...types import Cloud, StampedPoses
from .map_session import MapSession


class MapFilesError(Exception):
    """Why nothing was saved, and what to do."""


def save(session: MapSession, config: Config, directory: str) -> Path:
    """A new folder with map.ply, trajectory.txt, keyframes.txt and config.yaml; raises
    MapFilesError.

    All in the z-up map frame, as published; poses are of the camera's optical frame.
    """
    if not session.keyframes:
        raise MapFilesError('there is no keyframe yet, so there is nothing to save')
    folder = Path(directory).expanduser().absolute()
    try:
        folder = _new_folder(folder)
        write_ply(folder / 'map.ply', z_up_cloud(session.cloud()))
        write_tum_trajectory(folder / 'trajectory.txt', z_up(session.trajectory()))
        write_tum_trajectory(folder / 'keyframes.txt', z_up(session.keyframe_trajectory()))
        (folder / 'config.yaml').write_text(config.to_yaml(), encoding='utf-8')
    except OSError as error:
        raise MapFilesError(f'{folder}: cannot be written ({error.strerror}); set the parameter '
                            'save_directory to a folder that can') from error
    return folder


def z_up(poses: StampedPoses) -> StampedPoses:
    """In the map frame."""
    return StampedPoses(poses.stamps_ns, T_ZUP_OPTICAL.numpy() @ poses.T_world_cam)


def z_up_cloud(cloud: Cloud) -> Cloud:
    """In the map frame."""
    points = sim3.transform(T_ZUP_OPTICAL, torch.from_numpy(cloud.points)).numpy()
    return Cloud(np.ascontiguousarray(points), cloud.colours)


def _new_folder(directory: Path) -> Path:
    """Named by the time; a number follows where that is taken."""
    name = datetime.now().strftime('%Y-%m-%d_%H-%M-%S')
    for suffix in ('', *(f'_{n}' for n in range(2, 1000))):
        try:
            (directory / (name + suffix)).mkdir(parents=True)
            return directory / (name + suffix)
        except FileExistsError:
            if not directory.is_dir():
                raise
    raise FileExistsError(f'{directory} has a thousand folders of this second')
