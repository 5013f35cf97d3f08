"""Which topics of a bag are the images, their calibration and the ground truth."""

from __future__ import annotations

from dataclasses import dataclass, fields
from urllib.parse import parse_qsl

from aim_slam_ros.datasets.bags import Bag, BagTopic
from aim_slam_ros.datasets.base import DatasetError

IMAGE = 'sensor_msgs/msg/Image'
COMPRESSED = 'sensor_msgs/msg/CompressedImage'
CAMERA_INFO = 'sensor_msgs/msg/CameraInfo'
POSES = ('geometry_msgs/msg/PoseStamped', 'geometry_msgs/msg/TransformStamped',
         'nav_msgs/msg/Odometry')
NONE = 'none'
# Taken where a bag holds several image topics, the first that is there.
_USUAL = ('image', 'image/compressed')
_TRUTHS = ('groundtruth', 'ground_truth')


@dataclass(frozen=True)
class BagTopics:
    """What to take; empty: found by type and name, 'none': go without it.

    topic: images. camera_info: their calibration, by default the one beside them. groundtruth:
    poses of the camera's optical frame, by default a topic called groundtruth.
    """

    topic: str = ''
    camera_info: str = ''
    groundtruth: str = ''


@dataclass(frozen=True)
class ChosenTopics:
    """camera_info, groundtruth: None where the bag has none, or it is not wanted."""

    image: BagTopic
    camera_info: BagTopic | None
    groundtruth: BagTopic | None

    @property
    def all(self) -> list[BagTopic]:
        return [topic for topic in (self.image, self.camera_info, self.groundtruth) if topic]


def parsed_topics(source: str, query: str) -> BagTopics:
    """'topic=/left/image_raw&camera_info=none' of a source; raises DatasetError."""
    options = dict(parse_qsl(query, keep_blank_values=True))
    known = [field.name for field in fields(BagTopics)]
    if not options or not all(options.values()) or not set(options) <= set(known):
        raise DatasetError(source, f'"?{query}" is not understood', 'write BAG?topic=TOPIC, with '
                           '&camera_info=TOPIC or &groundtruth=TOPIC if wanted')
    return BagTopics(**options)


def choose_topics(bag: Bag, wanted: BagTopics) -> ChosenTopics:
    """Raises DatasetError, with what the bag holds, where there is no image topic or no choice."""
    image = _image(bag, wanted.topic)
    return ChosenTopics(image, _camera_info(bag, wanted.camera_info, image.name),
                        _groundtruth(bag, wanted.groundtruth))


def camera_info_beside(image_topic: str) -> str:
    """'/left/image_raw/compressed' to '/left/camera_info', as cameras publish it."""
    folder = image_topic.removesuffix('/compressed').rpartition('/')[0]
    return f'{folder}/camera_info'


def _image(bag: Bag, name: str) -> BagTopic:
    found = _of_types(bag, IMAGE, COMPRESSED)
    if name:
        return _named(bag, name, found, 'image topic')
    if not found:
        raise DatasetError(bag.path, 'holds no images (sensor_msgs Image or CompressedImage); its '
                           f'topics are {", ".join(bag.topics)}', 'name another bag')
    usual = [topic for name in _USUAL for topic in found if topic.name.strip('/') == name]
    # Depth images are of the same type, and no pictures.
    pictures = [topic for topic in found if 'depth' not in topic.name.lower()]
    for choice in (found, usual[:1], pictures):
        if len(choice) == 1:
            return choice[0]
    raise DatasetError(bag.path, f'holds several image topics: {_names(found)}',
                       f'choose one: {bag.path}?topic={found[0].name}')


def _camera_info(bag: Bag, name: str, image_topic: str) -> BagTopic | None:
    found = _of_types(bag, CAMERA_INFO)
    if name == NONE:
        return None
    if name:
        return _named(bag, name, found, 'camera_info topic')
    beside = camera_info_beside(image_topic)
    return next((topic for topic in found if topic.name == beside), None)


def _groundtruth(bag: Bag, name: str) -> BagTopic | None:
    found = _of_types(bag, *POSES)
    if name == NONE:
        return None
    if name:
        return _named(bag, name, found, 'PoseStamped, TransformStamped or Odometry topic')
    return next((topic for topic in found if topic.name.rpartition('/')[2] in _TRUTHS), None)


def _of_types(bag: Bag, *msgtypes: str) -> list[BagTopic]:
    return [topic for topic in bag.topics.values() if topic.msgtype in msgtypes and topic.conforms]


def _named(bag: Bag, name: str, found: list[BagTopic], kind: str) -> BagTopic:
    for topic in found:
        if topic.name.strip('/') == name.strip('/'):
            return topic
    there = f'it has {_names(found)}' if found else f'it has none (but {", ".join(bag.topics)})'
    raise DatasetError(bag.path, f'has no {kind} {name}; {there}', 'name one of these')


def _names(topics: list[BagTopic]) -> str:
    return ', '.join(f'{topic.name} ({topic.count} messages)' for topic in topics)
