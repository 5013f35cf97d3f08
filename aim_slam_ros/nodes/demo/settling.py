"""Whether the nodes have finished with what they were given."""

from __future__ import annotations

import time
from typing import Mapping

from msg_adapters.stamps import stamp_ns

from .collector import Topic
from .overview import FRONTEND, LOOP_CLOSURE, newest_status
from .received import Playback, received_run

# Rows after that of the last image tell what the model found out about earlier ones.
_RECENT_ROWS = 20
# So long without a word loop closure has nothing more to say: several periods of path and map.
_QUIET_NS = 10_000_000_000


def frontend_is_idle(topics: Mapping[str, Topic], last_image_ns: int) -> bool:
    """The image with this stamp, the last, was answered, and the model rests.

    An image may be answered while the model is still at work on an earlier one: the frontend's
    own word, given after its last answer, is needed too.
    """
    rows, status = topics['frame'], newest_status(topics, FRONTEND)
    if status.arrival_ns < arrival_ns(rows) or status.values.get('model_busy') != 'false':
        return False
    return any(stamp_ns(rows.read(heard).header.stamp) == last_image_ns
               for heard in rows.heard[-_RECENT_ROWS:])


def loop_closure_is_idle(topics: Mapping[str, Topic]) -> bool:
    """It has taken every keyframe in, and path and map hold all that they can hold.

    Ask it once the frontend is idle.
    """
    if topics['keyframe'].newest is None:
        return True     # there never was a map
    status = newest_status(topics, LOOP_CLOSURE)
    correction_ns = arrival_ns(topics['keyframe_poses'])
    if (status.arrival_ns < arrival_ns(topics['keyframe'])
            or status.values.get('pending_keyframes') != '0'
            or min(arrival_ns(topics['map']), arrival_ns(topics['path'])) < correction_ns):
        return False
    run = received_run(topics, Playback({}, 0, False))
    newest_keyframe_ns = max((keyframe.stamp_ns for keyframe in run.keyframes), default=0)
    return _map_stamp_ns(topics['map']) >= newest_keyframe_ns and (
        len(run.trajectory) == len(run.tracked) or _is_quiet(topics))


def arrival_ns(topic: Topic) -> int:
    """Of its newest message; 0 before the first."""
    newest = topic.newest
    return 0 if newest is None else newest.arrival_ns


def _map_stamp_ns(topic: Topic) -> int:
    """Of the newest keyframe in it."""
    message = topic.read_newest()
    return 0 if message is None else stamp_ns(message.header.stamp)


def _is_quiet(topics: Mapping[str, Topic]) -> bool:
    last_ns = max(arrival_ns(topics[name])
                  for name in ('frame', 'keyframe', 'keyframe_poses', 'path', 'map'))
    return time.monotonic_ns() - last_ns > _QUIET_NS
