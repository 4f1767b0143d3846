"""The plant that drives what a player publishes: waits for its announcement, then is a
``PlantSim`` whose demand arrives. No protocol in here, see ``topic_demand``."""

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from rclpy.node import Node

from tractor_msgs_py import topics
from tractor_msgs_py.codec import decode_duty_cycle_demand, decode_duty_cycle_info
from tractor_msgs_py.errors import BagError, RunAborted
from tractor_msgs_py.ros.shell import Logic
from tractor_msgs_py.ros.wire import subscribe_to
from tractor_sim.config import load_powertrain
from tractor_sim.nodes.plant_parameters import run_of
from tractor_sim.nodes.plant_sim import PlantSim
from tractor_sim.run_files import clear_run
from tractor_sim.topic_demand import TopicDemand

T = TypeVar("T")
QUEUE = 5000
"""Demands that may wait here: a player in real time does not wait for the plant."""


def build(node: Node, values: Mapping[str, Any]) -> Logic:
    """The plant that parameter ``demand`` asks for."""
    return PlantSim(node, values) if values["demand"] == "cycle" else TopicPlant(node, values)


class TopicPlant:
    """Carries a player's samples to the plant's run."""

    def __init__(self, node: Node, values: Mapping[str, Any]) -> None:
        self._node, self._values = node, values
        load_powertrain(values["powertrain"])  # what is wrong is said now, not with the player
        if values["output"]:
            clear_run(Path(values["output"]))
        self._demand: TopicDemand | None = None
        self._plant: PlantSim | None = None
        self._since_s = time.monotonic()
        demand = topics.DUTY_CYCLE_DEMAND
        # The announcement comes first: what is ready together runs in the order of creation.
        subscribe_to(node, topics.DUTY_CYCLE_INFO, self._on_info)
        self._demands = subscribe_to(
            node, replace(demand, qos=replace(demand.qos, depth=QUEUE)), self._on_demand
        )

    def _decoded(self, decode: Callable[[Any], T], msg: Any) -> T | None:
        """The sample, or None where it is malformed: reported."""
        try:
            return decode(msg)
        except BagError as error:
            self._node.get_logger().warning(f"refused: {error}", throttle_duration_sec=1.0)
            return None

    def _on_info(self, msg: Any) -> None:
        info = self._decoded(decode_duty_cycle_info, msg)
        if info is None:
            return
        if self._demand is not None:
            self._demand.announce(info)
        elif self._plant is None:
            run = run_of(self._values, info)
            self._demand = TopicDemand(run, info, self._values["demand_timeout_s"])
            self._plant = PlantSim(self._node, self._values, run)

    def _on_demand(self, msg: Any) -> None:
        demand = self._decoded(decode_duty_cycle_demand, msg)
        if demand is not None and self._demand is not None and self._plant is not None:
            self._demand.offer(demand)
            if self._plant.started:
                self._plant.poll()

    def finished(self) -> int | None:
        """What the plant says once there is one.

        Raises:
            RunAborted: no player within ``match_timeout_s``, two of them, or one that fell silent.
        """
        now_s, publishers = time.monotonic(), self._demands.get_publisher_count()
        if self._plant is None or self._demand is None:
            waiting = f"no {topics.DUTY_CYCLE_INFO.name}: no player has announced a cycle"
            self._node.get_logger().info(f"waiting: {waiting}", throttle_duration_sec=30.0)
            timeout_s = self._values["match_timeout_s"]
            if 0.0 < timeout_s < now_s - self._since_s:
                raise RunAborted(f"not started within {timeout_s:g} s: {waiting}")
            return None
        self._demand.check(publishers, self._plant.started, now_s)
        return self._plant.finished()

    def shutdown(self) -> None:
        """Nothing to make safe: the plant is simulated."""
