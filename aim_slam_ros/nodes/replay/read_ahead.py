"""Messages of a bag, read a little before they are needed."""

from __future__ import annotations

import threading
from collections import deque
from typing import Iterator

from ...datasets.bags import BagMessage
from ...datasets.base import DatasetError

_BUDGET_BYTES = 64 << 20    # some seconds of a VGA camera
_JOIN_S = 1.0               # a chunk of a bag takes less


class ReadAhead:
    """Iterates over the messages, which a thread of its own reads: the disk costs no time.

    Raises the DatasetError of the messages where it occurs in their order.
    """

    def __init__(self, messages: Iterator[BagMessage]) -> None:
        self._messages = messages
        self._read: deque[BagMessage | DatasetError | None] = deque()
        self._bytes = 0
        self._closed = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name='read ahead', daemon=True)
        self._thread.start()

    def __iter__(self) -> Iterator[BagMessage]:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._read)
                message = self._read.popleft()
                self._bytes -= _size(message)
                self._changed.notify_all()
            if message is None:
                return
            if isinstance(message, DatasetError):
                raise message
            yield message

    def close(self) -> None:
        """End the reading; the bag is free then."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(_JOIN_S)

    def _run(self) -> None:
        try:
            for message in self._messages:
                if not self._put(message):
                    return
        except DatasetError as error:
            self._put(error)
            return
        self._put(None)

    def _put(self, message: BagMessage | DatasetError | None) -> bool:
        """False where nobody reads on. One message fits in any case."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._bytes < _BUDGET_BYTES)
            self._read.append(message)
            self._bytes += _size(message)
            self._changed.notify_all()
            return not self._closed


def _size(message: BagMessage | DatasetError | None) -> int:
    return len(message.cdr or b'') if isinstance(message, BagMessage) else 0
