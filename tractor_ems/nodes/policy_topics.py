"""What a policy node says: its command while it drives, its wish in the shadow. No decisions."""

import time
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher

from tractor_ems.latency import Latencies
from tractor_msgs_py import topics
from tractor_msgs_py.codec import encode
from tractor_msgs_py.ros.delivery import Delivery
from tractor_msgs_py.ros.messages import RosMessages
from tractor_msgs_py.ros.wire import publish_on
from tractor_msgs_py.types import BatteryPowerCommand, CommandMode

LINGER_S = 0.2
"""How long a publisher stays after its last command, so that it arrives [s]."""

LAST_S = 1.0
"""How long the last command of all is repeated to a subscriber that does not acknowledge [s]."""

SHADOW = topics.Topic("~/shadow_command", topics.JOINT_STATE)


class CommandOutlet:
    """The publishers of one policy. In the shadow there is none on the command topic, so that
    another policy is the only one there.

    Attributes:
        latencies: from an observation that is complete to its command that is published.
        mismatches: topic to the QoS policy that a peer there asks for or offers in vain.
    """

    def __init__(self, node: Node, history_depth: int, *, driving: bool, shadow: bool) -> None:
        self.latencies = Latencies()
        self.mismatches: dict[str, str] = {}
        self._node, self._depth, self._factory = node, history_depth, RosMessages()
        self._commands: Publisher | None = None
        self._leave_s: float | None = None
        self._wishes = publish_on(node, SHADOW, history_depth) if shadow else None
        if driving:
            self.open()

    def mismatch(self, topic: str, policy: str) -> None:
        """A peer's QoS does not fit: say so once, and in every diagnostics."""
        if self.mismatches.get(topic) != policy:
            self._node.get_logger().error(
                f"{topic}: a peer cannot be heard or does not hear, its QoS {policy} does not fit"
            )
        self.mismatches[topic] = policy

    def open(self) -> None:
        """Be a publisher on the command topic."""
        self._leave_s = None
        if self._commands is None:
            self._commands = publish_on(self._node, topics.COMMAND, self._depth, self.mismatch)

    def leave(self) -> None:
        """Be none any more, as soon as the last command has arrived."""
        if self._commands is not None and self._leave_s is None:
            self._leave_s = time.monotonic() + LINGER_S

    def tidy(self, now_s: float) -> None:
        """Time has passed."""
        if self._leave_s is not None and now_s >= self._leave_s and self._commands is not None:
            self._node.destroy_publisher(self._commands)
            self._commands, self._leave_s = None, None

    def listeners(self) -> int:
        """Subscribers of the command topic, 0 in the shadow."""
        return 0 if self._commands is None else self._commands.get_subscription_count()

    def others(self) -> int:
        """Other publishers on the command topic."""
        own = self._commands is not None
        name = self._node.resolve_topic_name(topics.COMMAND.name)  # counting does not remap
        return max(self._node.count_publishers(name) - own, 0)

    def names_of_others(self) -> str:
        """Nodes with a publisher on the command topic, this one left out."""
        infos = self._node.get_publishers_info_by_topic(topics.COMMAND.name)
        names = {f"{info.node_namespace.rstrip('/')}/{info.node_name}" for info in infos}
        return ", ".join(sorted(names - {self._node.get_fully_qualified_name()}))

    def say(self, command: BatteryPowerCommand | None, since_ns: int = 0) -> None:
        """Publish a command, if there is one; ``since_ns``: when its observation was complete."""
        if command is None or self._commands is None:
            return
        self._commands.publish(self._message(command))
        if since_ns and command.mode is CommandMode.NOMINAL:
            self.latencies.add((time.monotonic_ns() - since_ns) * 1e-9)

    def say_last(self, command: BatteryPowerCommand | None) -> None:
        """Publish the command that is left behind, and stay until everybody has it: with the
        process goes what is still on its way (measured: 1 of 40 did not arrive)."""
        if command is None or self._commands is None:
            return
        message = self._message(command)
        self._commands.publish(message)
        delivery, deadline_s = Delivery([(self._commands, message)]), time.monotonic() + LAST_S
        while not delivery.complete(time.monotonic()) and time.monotonic() < deadline_s:
            time.sleep(0.005)

    def wish(self, command: BatteryPowerCommand) -> None:
        """Publish what the policy would command, where somebody asked for a shadow."""
        if self._wishes is not None:
            self._wishes.publish(self._message(command))

    def _message(self, command: BatteryPowerCommand) -> Any:
        return encode(command, self._factory)[1]
