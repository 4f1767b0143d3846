"""Any policy as a ROS node: carries samples between the topics and the ``Answerer``.

The policy nodes beside it only declare their parameters and build their policy.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node

from tractor_ems.answer import Answerer, Observed, RunCheck
from tractor_ems.policies.protocol import Policy
from tractor_msgs_py import topics
from tractor_msgs_py.codec import (
    decode_battery,
    decode_power_demand,
    decode_powertrain,
    decode_run_info,
    encode,
)
from tractor_msgs_py.errors import BagError
from tractor_msgs_py.ros.diagnostics import PERIOD_S, diagnostic_array
from tractor_msgs_py.ros.messages import RosMessages
from tractor_msgs_py.ros.shell import Parameter, run_node
from tractor_msgs_py.ros.wire import HISTORY_DEPTH, publish_on, subscribe_to
from tractor_msgs_py.types import BatteryPowerCommand

T = TypeVar("T")
WATCHDOG_S = 0.05
OBSERVED: tuple[tuple[topics.Topic, Callable[[Any], Observed]], ...] = (
    (topics.POWER_DEMAND, decode_power_demand),
    (topics.BATTERY, decode_battery),
    (topics.POWERTRAIN, decode_powertrain),
)
COMMON = (
    Parameter("allow_other_powertrain", False, "drive a powertrain the policy was not made for"),
    Parameter(
        "observation_timeout_s", 2.0, "real time: fall back after silence of", "s", 0.01, 60
    ),
    HISTORY_DEPTH,
)


@dataclass(frozen=True)
class PolicySetup:
    """What a policy node runs.

    Attributes:
        policy: the decision maker.
        powertrain_hash: the powertrain it was made for; None when any will do.
        check_run: raises where the policy must not drive a run.
    """

    policy: Policy
    powertrain_hash: str | None = None
    check_run: RunCheck | None = None


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
        answerer = Answerer(setup.policy, made_for, timeout_s, setup.check_run)
        return PolicyNode(node, answerer, values["history_depth"])

    return run_node(name, (*parameters, *COMMON), build)


class PolicyNode:
    """Wires one ``Answerer`` to the topics."""

    def __init__(self, node: Node, answerer: Answerer, history_depth: int) -> None:
        self._node, self._answerer, self._factory = node, answerer, RosMessages()
        self._commands = publish_on(node, topics.COMMAND, history_depth)
        # run_info comes first: callbacks that are ready together run in the order of creation.
        subscribe_to(node, topics.RUN_INFO, self._on_run_info)
        for topic, decode in OBSERVED:
            subscribe_to(node, topic, self._on_sample(topic, decode))
        self._diagnostics = publish_on(node, topics.DIAGNOSTICS)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        node.create_timer(WATCHDOG_S, self._watch, clock=steady)
        node.create_timer(PERIOD_S, self._diagnose, clock=steady)

    def _on_run_info(self, msg: Any) -> None:
        run = self._decoded(topics.RUN_INFO, decode_run_info, msg)
        if run is not None:
            self._answerer.start_run(run)

    def _on_sample(
        self, topic: topics.Topic, decode: Callable[[Any], Observed]
    ) -> Callable[[Any], None]:
        subscribers = self._commands.get_subscription_count

        def on_sample(msg: Any) -> None:
            sample = self._decoded(topic, decode, msg)
            if sample is not None:
                self._publish(self._answerer.observe(sample, subscribers, time.monotonic()))

        return on_sample

    def _decoded(self, topic: topics.Topic, decode: Callable[[Any], T], msg: Any) -> T | None:
        """The sample, or None where it is malformed: counted and reported."""
        try:
            return decode(msg)
        except BagError as error:
            self._answerer.refusals[f"malformed_{topic.name}"] += 1
            self._node.get_logger().warning(f"refused: {error}", throttle_duration_sec=1.0)
            return None

    def _publish(self, command: BatteryPowerCommand | None) -> None:
        if command is not None:
            self._commands.publish(encode(command, self._factory)[1])

    def _watch(self) -> None:
        self._publish(self._answerer.overdue(time.monotonic()))

    def _diagnose(self) -> None:
        count, name = self._node.count_publishers(topics.COMMAND.name), topics.COMMAND.name
        if count > 1:
            self._node.get_logger().error(
                f"{count} publishers on {name}, allowed 1", throttle_duration_sec=10.0
            )
        answerer = self._answerer
        values = {
            "policy": answerer.policy.name,
            "run_id": answerer.run.run_id if answerer.run else "",
            "other_policies": count - 1,
            **answerer.counters,
        }
        state = "driving" if answerer.active else "waiting for a run"
        warning = count > 1 or answerer.corrected > 0 or answerer.fallbacks > 0
        self._diagnostics.publish(diagnostic_array(self._node, state, values, warning=warning))

    def finished(self) -> int | None:
        """A policy serves run after run until it is told to stop."""
        return None

    def shutdown(self) -> None:
        """Leave the safe command behind where a run is under way."""
        self._publish(self._answerer.shutdown_command())
