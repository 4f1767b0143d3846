"""A row of the wire contract as an rclpy publisher or subscription."""

from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription

from tractor_msgs_py.ros.messages import CLASSES
from tractor_msgs_py.ros.shell import qos_profile
from tractor_msgs_py.topics import Topic


def publish_on(node: Node, topic: Topic) -> Publisher:
    """A publisher on ``topic``."""
    return node.create_publisher(CLASSES[topic.type], topic.name, qos_profile(topic.qos))


def subscribe_to(node: Node, topic: Topic, callback: Callable[[Any], None]) -> Subscription:
    """A subscription to ``topic``; callbacks that are ready together run in order of creation."""
    return node.create_subscription(
        CLASSES[topic.type], topic.name, callback, qos_profile(topic.qos)
    )
