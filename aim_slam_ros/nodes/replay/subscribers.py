"""Waiting for somebody to listen."""

from __future__ import annotations

import threading
import time
from typing import Collection, Sequence

from rclpy.node import Node
from rclpy.publisher import Publisher

_LOOK_UP_S = 0.02


def wait_for_subscriber(publishers: Sequence[Publisher], timeout_s: float,
                        stop: threading.Event) -> bool:
    """Until one of the publishers has a subscriber; False where none came or stop was set."""
    deadline_s = time.monotonic() + timeout_s
    while not any(publisher.get_subscription_count() for publisher in publishers):
        if time.monotonic() >= deadline_s or stop.wait(_LOOK_UP_S):
            return False
    return True


def what_is_subscribed(node: Node, publishers: Sequence[Publisher],
                       msgtypes: Collection[str]) -> str:
    """Why nobody listens to these publishers, for a person: what the nodes subscribe to."""
    found = []
    for topic, types in sorted(node.get_topic_names_and_types()):
        names = sorted({f'{info.node_namespace.rstrip("/")}/{info.node_name}'
                        for info in node.get_subscriptions_info_by_topic(topic)})
        if names and not set(types).isdisjoint(msgtypes):
            found.append((topic, f'{topic} (by {", ".join(names)})'))
    own = {publisher.topic_name for publisher in publishers}
    refused = [text for topic, text in found if topic in own]
    if refused:
        return (f'{", ".join(refused)} is subscribed to with a QoS that does not match: this is '
                'reliable and volatile')
    if found:
        return f'nodes subscribe to {", ".join(text for _, text in found)}'
    return 'no node subscribes to images'
