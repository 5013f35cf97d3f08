"""The images of a bag as a dataset."""

from __future__ import annotations

import weakref
from pathlib import Path
from typing import Iterator

import numpy as np
from rosbags.serde import SerdeError

from aim_slam_ros.datasets.bag_scan import BagScan
from aim_slam_ros.datasets.bag_topics import (COMPRESSED, BagTopics, ChosenTopics,
                                              choose_topics)
from aim_slam_ros.datasets.bags import STORE, Bag, BagMessage
from aim_slam_ros.datasets.base import DatasetError, ImageError, Sequence
from msg_adapters.encodings import rgb_from_compressed, rgb_from_image
from msg_adapters.errors import MessageError

# Reading over so many images is cheaper than looking for the next one by its time.
_READ_OVER = 16


class BagSequence(Sequence):
    """One image topic, with the camera_info and ground truth recorded beside it.

    Stamps are those of the headers; the time of recording where a header has none. Fastest when
    read in order; images are read when asked for.
    """

    def __init__(self, path: Path, topics: BagTopics = BagTopics()) -> None:
        """Reads through the bag once, for the stamps; raises DatasetError."""
        self._bag = Bag(path)
        weakref.finalize(self, self._bag.close)
        self._topics = choose_topics(self._bag, topics)
        found = BagScan(self._bag, self._topics)
        stamps_ns = np.array(found.stamps_ns, np.int64)
        newest = np.maximum.accumulate(stamps_ns)
        kept = np.flatnonzero(np.diff(newest, prepend=newest[0] - 1) > 0)
        super().__init__(path.resolve().stem, stamps_ns[kept], found.calibration(),
                         found.groundtruth(), len(stamps_ns) - len(kept), found.torn)
        # _log_ns: of every image message in the order of reading; _message: those delivered.
        self._log_ns = np.array(found.log_ns, np.int64)
        self._message = np.array(found.message, np.int64)[kept]
        self._next = 0
        self._coming: Iterator[tuple[int, BagMessage]] | None = None
        self._check_size()

    @property
    def path(self) -> Path:
        """Of the bag."""
        return self._bag.path

    @property
    def topics(self) -> ChosenTopics:
        """What is taken of the bag."""
        return self._topics

    @property
    def topic(self) -> str:
        """The image topic."""
        return self._topics.image.name

    def image(self, index: int) -> np.ndarray:
        cdr = self._cdr(index)
        msgtype = self._topics.image.msgtype
        decode = rgb_from_compressed if msgtype == COMPRESSED else rgb_from_image
        try:
            if cdr is None:
                raise MessageError('the message is damaged')
            rgb = decode(STORE.deserialize_cdr(memoryview(cdr), msgtype))
        except (SerdeError, MessageError) as error:
            raise self._image_error(index, str(error)) from error
        # It may be a view of the message, which nobody can write into.
        return rgb if rgb.flags.writeable else rgb.copy()

    def _cdr(self, index: int) -> bytes | None:
        if not -len(self) <= index < len(self):
            raise IndexError(f'{self._bag.path}: image {index} of {len(self)}')
        wanted = int(self._message[index])
        if self._coming is None or not self._next <= wanted < self._next + _READ_OVER:
            self._coming = self._from(wanted)
        try:
            for number, message in self._coming:
                self._next = number + 1
                if number == wanted:
                    return message.cdr
        except DatasetError as error:
            self._coming = None
            raise self._image_error(index, str(error)) from error
        self._coming = None
        raise self._image_error(index, 'the bag was changed while it was read')

    def _from(self, number: int) -> Iterator[tuple[int, BagMessage]]:
        """Image messages with their numbers, from shortly before this one on."""
        start_ns = int(self._log_ns[number])
        numbers = np.flatnonzero(self._log_ns >= start_ns).tolist()
        return zip(numbers, self._bag.messages([self.topic], start_ns))

    def _image_error(self, index: int, reason: str) -> ImageError:
        return ImageError(self._bag.path, f'image {index} of {self.topic}: {reason}')

    def _check_size(self) -> None:
        if self.calibration is None or not self.calibration.width or not self.calibration.height:
            return
        try:
            height, width = self.image(0).shape[:2]
        except ImageError:
            return      # says nothing about the size
        expected = (self.calibration.width, self.calibration.height)
        if (width, height) != expected:
            raise DatasetError(
                self._bag.path, f'the images of {self.topic} have {width}x{height} pixels, their '
                f'camera_info is for {expected[0]}x{expected[1]}',
                'name the one that belongs to them with ?camera_info=TOPIC, or go without: '
                '?camera_info=none')
