"""What the frontend node can be told besides the settings of config.py."""

from __future__ import annotations

from dataclasses import dataclass

from ...settings import Section, setting


@dataclass(frozen=True)
class FrontendParameters(Section):
    image_transport: str = setting(
        'raw', 'raw subscribes image, compressed subscribes image/compressed',
        choices=('raw', 'compressed'))
    image_reliability: str = setting(
        'auto', "QoS of the image subscription; auto takes what the images' publishers offer",
        choices=('auto', 'reliable', 'best_effort'))
    image_timeout_s: float = setting(
        5.0, 'after so long without an image the node says what it waits for [s]', 0.1, 3600)
    map_frame: str = setting('map', "frame of the keyframes' poses, z up")
    odom_frame: str = setting('odom', 'frame of pose, odometry and points, z up; never jumps')
    base_frame: str = setting(
        '', "the robot's frame: odometry and TF are of it where TF knows the camera in it; "
        'empty: of the camera')
    camera_frame: str = setting(
        '', "the camera's optical frame; empty: the frame_id of the images")
    publish_tf: bool = setting(True, 'broadcast odom to camera (or base_frame), where TF is there')
    publish_points: bool = setting(True, 'publish the newest keyframe as points')
    resend_hz: float = setting(
        10.0, 'keyframes sent per second when another node asks for all of them', 0.1, 1000)
