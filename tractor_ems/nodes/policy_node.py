"""Any policy as a ROS node: carries samples between the topics and who answers.

The policy nodes beside it only declare their parameters and build their policy.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from rclpy.node import Node

from tractor_ems.answer import Answerer, Observed
from tractor_ems.nodes.driving_node import DrivingNode
from tractor_ems.nodes.policy_of_run import PolicyOfRun
from tractor_ems.nodes.policy_parameters import COMMON, PLANNED_WORK, SOC_TARGET
from tractor_ems.nodes.policy_setup import Paperwork, PolicySetup, answerer_of, papers_of
from tractor_msgs_py import topics
from tractor_msgs_py.codec import decode_battery, decode_power_demand, decode_powertrain
from tractor_msgs_py.ros.shell import Logic, Parameter, run_node
from tractor_msgs_py.ros.wire import arrived_ns, subscribe_to

__all__ = ["COMMON", "PolicyNode", "PolicySetup", "run_policy_node"]

OBSERVED: tuple[tuple[topics.Topic, Callable[[Any], Observed]], ...] = (
    (topics.POWER_DEMAND, decode_power_demand),
    (topics.BATTERY, decode_battery),
    (topics.POWERTRAIN, decode_powertrain),
)


def run_policy_node(
    name: str,
    parameters: Sequence[Parameter],
    prepare: Callable[[Mapping[str, Any]], PolicySetup | None],
) -> int:
    """Run one policy until a signal arrives; returns the exit code of ``run_node``.

    Args:
        name: of the node.
        parameters: of its own.
        prepare: the policy that its values ask for; None: the first run must say which
            powertrain it has, and ``prepare`` is asked again with its name.
    """
    solved = any(parameter.name == SOC_TARGET.name for parameter in parameters)

    def begin(node: Node, values: Mapping[str, Any]) -> Logic:
        setup = prepare(values)
        return PolicyOfRun(node, values, chosen) if setup is None else build(node, values, setup)

    def chosen(node: Node, values: Mapping[str, Any]) -> DrivingNode:
        setup = prepare(values)
        assert setup is not None, "a powertrain is named"
        return build(node, values, setup)

    def build(node: Node, values: Mapping[str, Any], setup: PolicySetup) -> DrivingNode:
        answerer = answerer_of(setup, values)
        papers = papers_of(setup, answerer, values)
        if isinstance(answerer, Answerer):
            return PolicyNode(node, answerer, values["history_depth"], papers)
        from tractor_ems.nodes.vehicle_node import VehicleNode

        return VehicleNode(node, answerer, values["history_depth"], papers)

    return run_node(
        name, (*parameters, *COMMON, *(() if solved else (SOC_TARGET, PLANNED_WORK))), begin
    )


class PolicyNode(DrivingNode):
    """Wires one ``Answerer`` to the simulator's topics, joined by equal stamps."""

    def __init__(
        self,
        node: Node,
        answerer: Answerer,
        history_depth: int,
        papers: Paperwork | None = None,
    ) -> None:
        self._answerer, self._depth = answerer, history_depth
        super().__init__(node, answerer, history_depth, papers)

    def _listen(self) -> None:
        for topic, decode in OBSERVED:
            on_sample = self._on_sample(topic, decode)
            deep = replace(topic.qos, depth=max(topic.qos.depth, self._depth))
            subscribe_to(self._node, replace(topic, qos=deep), on_sample, self.outlet.mismatch)

    def _on_sample(
        self, topic: topics.Topic, decode: Callable[[Any], Observed]
    ) -> Callable[[Any, Any], None]:
        def on_sample(msg: Any, info: Any) -> None:
            now_ns = time.monotonic_ns()
            sample = self._decoded(topic, decode, msg)
            if sample is None:
                return
            answerer = self._answerer
            command = answerer.observe(sample, self.outlet.listeners, now_ns * 1e-9)
            self.outlet.say(command, arrived_ns(info, now_ns))
            self._follow(answerer.decision)

        return on_sample
