"""Any policy as a ROS node: carries samples between the topics and the ``Answerer``.

The policy nodes beside it only declare their parameters and build their policy.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node

from tractor_ems.answer import Answerer, RunGuard
from tractor_ems.policies.protocol import Policy
from tractor_msgs_py import topics
from tractor_msgs_py.codec import DECODERS, decode_run_info, encode
from tractor_msgs_py.errors import BagError
from tractor_msgs_py.ros.diagnostics import PERIOD_S, diagnostic_array, diagnostics_publisher
from tractor_msgs_py.ros.messages import CLASSES, RosMessages
from tractor_msgs_py.ros.shell import Parameter, qos_profile, run_node
from tractor_msgs_py.types import BatteryPowerCommand

WATCHDOG_S = 0.05
COMMON = (
    Parameter("allow_other_powertrain", False, "drive a powertrain the policy was not made for"),
    Parameter(
        "observation_timeout_s",
        2.0,
        "real time: fall back when nothing was observed for this long",
        "s wall clock",
        0.01,
        60,
    ),
)


@dataclass(frozen=True)
class PolicySetup:
    """What a policy node runs.

    Attributes:
        policy: the decision maker.
        powertrain_hash: the powertrain it was made for; None when any will do.
        guard: further checks of runs and observations.
    """

    policy: Policy
    powertrain_hash: str | None = None
    guard: RunGuard | None = None


def run_policy_node(
    name: str,
    parameters: Sequence[Parameter],
    prepare: Callable[[Mapping[str, Any]], PolicySetup],
) -> int:
    """Run one policy until a signal arrives; returns the exit code of ``run_node``."""

    def build(node: Node, values: Mapping[str, Any]) -> PolicyNode:
        setup = prepare(values)
        made_for = None if values["allow_other_powertrain"] else setup.powertrain_hash
        timeout_s = values["observation_timeout_s"]
        return PolicyNode(node, Answerer(setup.policy, made_for, timeout_s, setup.guard))

    return run_node(name, (*parameters, *COMMON), build)


class PolicyNode:
    """Wires one ``Answerer`` to the topics."""

    def __init__(self, node: Node, answerer: Answerer) -> None:
        self._node, self._answerer, self._factory = node, answerer, RosMessages()
        self._other_policies = 0
        self._commands = node.create_publisher(
            CLASSES[topics.COMMAND.type], topics.COMMAND.name, qos_profile(topics.COMMAND.qos)
        )
        # run_info comes first: callbacks that are ready together run in the order of creation.
        self._subscribe(topics.RUN_INFO, self._on_run_info)
        for topic in (topics.POWER_DEMAND, topics.BATTERY, topics.POWERTRAIN):
            self._subscribe(topic, self._on_sample(topic))
        self._diagnostics = diagnostics_publisher(node)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        node.create_timer(WATCHDOG_S, self._watch, clock=steady)
        node.create_timer(PERIOD_S, self._diagnose, clock=steady)

    def _subscribe(self, topic: topics.Topic, callback: Callable[[Any], None]) -> None:
        self._node.create_subscription(
            CLASSES[topic.type], topic.name, callback, qos_profile(topic.qos)
        )

    def _on_run_info(self, msg: Any) -> None:
        try:
            run = decode_run_info(msg)
        except BagError as error:
            self._refuse("malformed_run_info", error)
            return
        self._answerer.start_run(run)

    def _on_sample(self, topic: topics.Topic) -> Callable[[Any], None]:
        decode = DECODERS[topic.name]

        def on_sample(msg: Any) -> None:
            try:
                sample = decode(msg)
            except BagError as error:
                self._refuse(f"malformed_{topic.name}", error)
                return
            self._publish(
                self._answerer.observe(
                    sample, self._commands.get_subscription_count, time.monotonic()
                )
            )

        return on_sample

    def _refuse(self, reason: str, error: BagError) -> None:
        self._answerer.refusals[reason] += 1
        self._node.get_logger().warning(f"refused: {error}", throttle_duration_sec=1.0)

    def _publish(self, command: BatteryPowerCommand | None) -> None:
        if command is not None:
            self._commands.publish(encode(command, self._factory)[1])

    def _watch(self) -> None:
        self._publish(self._answerer.overdue(time.monotonic()))

    def _diagnose(self) -> None:
        others = self._node.count_publishers(topics.COMMAND.name) - 1
        if others > self._other_policies:
            self._node.get_logger().error(
                f"{others + 1} publishers on {topics.COMMAND.name}, allowed 1"
            )
        self._other_policies = others
        answerer = self._answerer
        values = {
            "policy": answerer.policy.name,
            "run_id": answerer.run.run_id if answerer.run else "",
            "other_policies": others,
            "corrected": answerer.corrected,
            "fallbacks": answerer.fallbacks,
            **{f"refused_{name}": count for name, count in sorted(answerer.refusals.items())},
        }
        warning = others > 0 or answerer.corrected > 0 or answerer.fallbacks > 0
        state = "driving" if answerer.active else "waiting for a run"
        self._diagnostics.publish(diagnostic_array(self._node, state, values, warning=warning))

    def finished(self) -> int | None:
        """A policy serves run after run until it is told to stop."""
        return None

    def shutdown(self) -> None:
        """Leave the safe command behind where a run is under way."""
        self._publish(self._answerer.shutdown_command())
