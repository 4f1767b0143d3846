"""A row of the wire contract as an rclpy publisher or subscription."""

import importlib
import re
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any, TypeAlias

from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import qos_policy_name_from_kind
from rclpy.subscription import Subscription

from tractor_msgs_py.errors import ConfigError
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


WAIT_MAX_NS = 60_000_000_000
"""A message has not waited longer than this; the system's clock was set."""

_TYPE = re.compile(r"([a-z][a-z0-9_]*)/msg/([A-Za-z][A-Za-z0-9]*)")

Mismatch: TypeAlias = Callable[[str, str], None]
"""Told of a peer that cannot be heard: topic, and the QoS policy that does not fit."""


def publish_on(
    node: Node, topic: Topic, depth: int | None = None, mismatch: Mismatch | None = None
) -> Publisher:
    """A publisher on ``topic``; ``depth`` is its history, None the contract's."""
    qos = topic.qos if depth is None else replace(topic.qos, depth=depth)
    return node.create_publisher(
        CLASSES[topic.type],
        topic.name,
        qos_profile(qos),
        event_callbacks=PublisherEventCallbacks(
            incompatible_qos=_told(node, topic.name, mismatch)
        ),
    )


def subscribe_to(
    node: Node,
    topic: Topic,
    callback: Callable[..., None],
    mismatch: Mismatch | None = None,
    message_class: Any = None,
) -> Subscription:
    """A subscription to ``topic``; callbacks that are ready together run in order of creation.

    Args:
        node: whose it is.
        topic: what to hear.
        callback: of the message alone, or of message and info.
        mismatch: told of a publisher whose QoS does not fit; None: the log alone.
        message_class: of a type that is not of the contract.
    """
    return node.create_subscription(
        message_class or CLASSES[topic.type],
        topic.name,
        callback,
        qos_profile(topic.qos),
        event_callbacks=SubscriptionEventCallbacks(
            incompatible_qos=_told(node, topic.name, mismatch)
        ),
    )


def arrived_ns(info: Mapping[str, Any], now_ns: int) -> int:
    """When a message arrived here, by the clock of ``now_ns``, before it waited for its turn."""
    waited_ns = time.time_ns() - int(info["received_timestamp"])
    return now_ns - min(max(waited_ns, 0), WAIT_MAX_NS)


def waiting(subscription: Subscription, most: int) -> Iterator[tuple[Any, Any]]:
    """Messages that wait for their turn, each with its info, at most ``most``.

    The executor asks the middleware about every entity of the node before each message, which
    costs more than the message; this takes a flood's messages ten times as fast. rclpy has no
    public way.
    """
    for _ in range(most):
        with subscription.handle:
            taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
        if taken is None:
            return
        yield taken[0], taken[1]


def message_class(type_name: str) -> Any:
    """The class of a ROS message type such as ``std_msgs/msg/Float64``.

    Raises:
        ConfigError: it is no type name, or the type or its package is not installed.
    """
    match = _TYPE.fullmatch(type_name)
    if match is None:  # a name from a stranger's bag is not imported unseen
        raise ConfigError(f"type {type_name!r}: expected pkg/msg/Name")
    package, name = match.groups()
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except ImportError:
        raise ConfigError(f"type {type_name}: package {package} is not installed") from None
    except AttributeError:
        raise ConfigError(f"type {type_name}: package {package} has no such message") from None


def _told(node: Node, name: str, mismatch: Mismatch | None) -> Callable[[Any], None] | None:
    if mismatch is None:
        return None  # rclpy logs a warning

    def tell(event: Any) -> None:
        mismatch(node.resolve_topic_name(name), qos_policy_name_from_kind(event.last_policy_kind))

    return tell
