"""What stands in for tf2_ros, which the wheels of ROS 2 lack: a process finds it in its folder."""

from __future__ import annotations

STAND_IN = """
class TransformException(Exception):
    pass


class TransformBroadcaster:
    def __init__(self, node):
        pass

    def sendTransform(self, transform):
        print('sent', transform.header.stamp.nanosec, transform.header.frame_id,
              transform.child_frame_id)
        Buffer.known[transform.header.frame_id, transform.child_frame_id] = transform


class Buffer:
    known = {}

    def lookup_transform(self, target_frame, source_frame, time):
        if (target_frame, source_frame) not in self.known:
            raise TransformException('unknown')
        return self.known[target_frame, source_frame]


class TransformListener:
    def __init__(self, buffer, node):
        pass
"""
