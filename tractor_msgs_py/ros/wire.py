"""A row of the wire contract as an rclpy publisher or subscription."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription

from tractor_msgs_py.ros.messages import CLASSES
from tractor_msgs_py.ros.shell import Parameter, qos_profile
from tractor_msgs_py.topics import Topic

HISTORY_DEPTH = Parameter(
    "history_depth",
    10,
    "messages kept for a subscriber that is behind, more where every one must be recorded",
    "messages",
    1,
    1_000_000,
)


def publish_on(node: Node, topic: Topic, depth: int | None = None) -> Publisher:
    """A publisher on ``topic``; ``depth`` is its history, None the contract's."""
    qos = topic.qos if depth is None else replace(topic.qos, depth=depth)
    return node.create_publisher(CLASSES[topic.type], topic.name, qos_profile(qos))


def subscribe_to(node: Node, topic: Topic, callback: Callable[[Any], None]) -> Subscription:
    """A subscription to ``topic``; callbacks that are ready together run in order of creation."""
    return node.create_subscription(
        CLASSES[topic.type], topic.name, callback, qos_profile(topic.qos)
    )
