"""What is saved of a map, and why it may not be."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import room_walk
import yaml
from keyframe_source import image_at

from aim_slam_ros.config import Config
from aim_slam_ros.datasets.text import read_tum_trajectory
from aim_slam_ros.nodes.loop_closure.map_files import MapFilesError, save
from aim_slam_ros.nodes.loop_closure.map_session import MapSession
from aim_slam_ros.types import FrameReport
from msg_adapters.poses import T_ZUP_OPTICAL


def session(keyframes: int, images: bool = True) -> MapSession:
    made = MapSession(1, Config(), room_walk.RoomModel(), gap_s=1.0)
    for event in room_walk.drifting_events(0.0)[:keyframes]:
        made.add(event)
        image = image_at(event, 0.1, event.stamp_ns + 1)
        if images:
            made.place(FrameReport(1, image, image.T_world_cam))
    return made


def test_everything_is_in_the_map_frame(tmp_path: Path) -> None:
    made = session(3)
    folder = save(made, Config(), str(tmp_path / 'new' / 'maps'))
    assert folder.parent == tmp_path / 'new' / 'maps'
    assert {p.name for p in folder.iterdir()} == {'map.ply', 'trajectory.txt', 'keyframes.txt',
                                                  'config.yaml'}
    expected = T_ZUP_OPTICAL.numpy() @ made.keyframe_trajectory().T_world_cam
    written = read_tum_trajectory(folder / 'keyframes.txt')
    np.testing.assert_allclose(written.T_world_cam, expected, atol=1e-7)   # eight decimals
    assert len(read_tum_trajectory(folder / 'trajectory.txt')) == 3
    assert yaml.safe_load((folder / 'config.yaml').read_text()) == yaml.safe_load(
        Config().to_yaml())


def test_a_second_one_has_a_folder_of_its_own(tmp_path: Path) -> None:
    made = session(1)
    assert len({save(made, Config(), str(tmp_path)) for _ in range(3)}) == 3


def test_keyframes_alone_are_a_map_too(tmp_path: Path) -> None:
    """After a restart the keyframes come again, the images do not."""
    folder = save(session(2, images=False), Config(), str(tmp_path))
    assert len(read_tum_trajectory(folder / 'keyframes.txt')) == 2
    assert (folder / 'trajectory.txt').read_text().startswith('#')


def test_an_empty_map_is_not_saved(tmp_path: Path) -> None:
    with pytest.raises(MapFilesError, match='nothing to save'):
        save(session(0), Config(), str(tmp_path))
    assert not list(tmp_path.iterdir())


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / 'file').write_text('')
    with pytest.raises(MapFilesError, match='file.*save_directory'):
        save(session(1), Config(), str(tmp_path / 'file'))
