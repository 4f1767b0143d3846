"""Publishers of recorded topics, as far as their message types are installed."""

from collections.abc import Iterable

from rclpy.exceptions import InvalidTopicNameException
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.validate_topic_name import validate_topic_name

from tractor_ems.bags.replay_topics import RecordedTopic
from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.ros.shell import qos_profile
from tractor_msgs_py.ros.wire import message_class


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
        try:
            found = message_class(topic.type)
        except ConfigError:
            skipped.append(f"{topic.name} ({topic.type})")
            continue
        if not _is_name(topic.name):
            skipped.append(f"{topic.name!r} (no ROS name)")
            continue
        publishers[topic.name] = node.create_publisher(
            found, topic.name.lstrip("/"), qos_profile(topic.qos)
        )
    return publishers, skipped
