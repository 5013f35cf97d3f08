"""What the loop-closure node can be told besides the settings of config.py."""

from __future__ import annotations

from dataclasses import dataclass

from ...settings import ConfigError, Section, setting


@dataclass(frozen=True)
class LoopClosureParameters(Section):
    map_frame: str = setting('map', 'frame of everything corrected, z up')
    odom_frame: str = setting('odom', "the frontend's frame, z up; never jumps")
    publish_tf: bool = setting(True, 'broadcast map to odom, where TF is there')
    map_period_s: float = setting(
        3.0, 'the map is published at most this often, after changes [s]', 0.1, 3600)
    path_period_s: float = setting(
        1.0, 'the path is published at most this often, after changes [s]', 0.1, 3600)
    gap_s: float = setting(
        5.0, 'after so long without a keyframe that is known to exist, the frontend is asked for '
        'all of them again; reliable delivery may take 3 s to repair a loss [s]', 0.1, 3600)
    silence_s: float = setting(
        5.0, 'after so long without a message the frontend is reported as silent [s]', 0.1, 3600)
    save_directory: str = setting(
        '~/aim_slam_maps', 'where ~/save_map makes a new folder with map and trajectories')
    save_on_new_session: bool = setting(
        False, 'save the map of a frontend that was restarted or reset before forgetting it')

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.map_frame or not self.odom_frame or self.map_frame == self.odom_frame:
            raise ConfigError(f'map_frame and odom_frame: {self.map_frame!r} and '
                              f'{self.odom_frame!r} are not two names; give two different ones')
