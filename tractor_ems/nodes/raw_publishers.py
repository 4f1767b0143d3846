"""Publishers of recorded topics: message classes by type name, whatever is installed."""

import importlib
import re
from collections.abc import Iterable
from typing import Any

from rclpy.exceptions import InvalidTopicNameException
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.validate_topic_name import validate_topic_name

from tractor_ems.bags.replay_topics import RecordedTopic
from tractor_msgs_py.ros.shell import qos_profile

_TYPE = re.compile(r"([a-z][a-z0-9_]*)/msg/([A-Za-z][A-Za-z0-9]*)")


def message_class(type_name: str) -> Any | None:
    """The installed message class of a ROS type name, or None."""
    match = _TYPE.fullmatch(type_name)
    if match is None:
        return None
    try:
        return getattr(importlib.import_module(f"{match[1]}.msg"), match[2])
    except (ImportError, AttributeError):
        return None


def _is_name(name: str) -> bool:
    """What ROS takes for a topic; a bag of another writer can hold any text."""
    try:
        return bool(validate_topic_name(name))
    except InvalidTopicNameException:
        return False


def raw_publishers(
    node: Node, topics: Iterable[RecordedTopic]
) -> tuple[dict[str, Publisher], list[str]]:
    """Publishers by recorded name with the recorded QoS, and topics whose type is not installed
    or whose name ROS refuses.

    The names are made relative, so that a namespace moves them as it does those of every node.
    """
    publishers: dict[str, Publisher] = {}
    skipped = []
    for topic in topics:
        found = message_class(topic.type)
        if found is None:
            skipped.append(f"{topic.name} ({topic.type})")
        elif not _is_name(topic.name):
            skipped.append(f"{topic.name!r} (no ROS name)")
        else:
            publishers[topic.name] = node.create_publisher(
                found, topic.name.lstrip("/"), qos_profile(topic.qos)
            )
    return publishers, skipped
