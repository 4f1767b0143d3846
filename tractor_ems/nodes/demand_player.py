"""Publishes the power demand of a bag for a plant that is told to drive it. No protocol in here.

``bags.replay`` reads the demand, ``bags.replay_demand`` decides when which step is published.
"""

import time
import uuid
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node

from tractor_ems.bags.replay import ANNOUNCED_AUX_W, DemandTrace, demand_of, mapped_demand_of
from tractor_ems.bags.replay_demand import DemandReplay
from tractor_ems.signals.config import load_signal_map
from tractor_msgs_py import __version__, topics
from tractor_msgs_py.codec import decode_power_demand, decode_run_info, encode
from tractor_msgs_py.errors import BagError, ConfigError, RunAborted
from tractor_msgs_py.provenance import command_line
from tractor_msgs_py.ros.diagnostics import PERIOD_S, diagnostic_array
from tractor_msgs_py.ros.messages import RosMessages
from tractor_msgs_py.ros.wire import publish_on, subscribe_to
from tractor_msgs_py.types import DEFAULT_T0_NS, DutyCycleDemand, DutyCycleInfo
from tractor_sim.duty_cycle.cycle import cycle_hash

POLL_S = 0.02
"""How often the player looks whether it is time for something, at the least [s]."""

MIN_PERIOD_S = 0.005
"""Shortest step in real time, as the plant's [s]."""

QUEUE = 5000
"""Ticks that may wait here, and demands for a plant that is busy."""


def _trace(values: Mapping[str, Any]) -> DemandTrace:
    bag, run, aux_w = Path(values["bag"]), values["run"], values["aux_w"]
    if not values["signals"]:
        return demand_of(bag, run, aux_w)
    for name, value, unset in (("run", run, 0), ("aux_w", aux_w, ANNOUNCED_AUX_W)):
        if value != unset:
            raise ConfigError(f"parameter {name}: {value:g}, not allowed beside signals")
    return mapped_demand_of(bag, load_signal_map(values["signals"]), values["dt_s"])


class DemandPlayer:
    """Carries samples between the topics and the replay."""

    def __init__(self, node: Node, values: Mapping[str, Any]) -> None:
        self._node, self._factory = node, RosMessages()
        trace = _trace(values)
        cycle = trace.cut(values["start_s"], values["duration_s"]).cycle
        period_s = cycle.dt_s / values["rate"] if values["pace"] == "real_time" else 0.0
        if 0.0 < period_s < MIN_PERIOD_S:
            raise ConfigError(
                f"parameter rate: {values['rate']:g} makes steps of {period_s:g} s, allowed from "
                f"{MIN_PERIOD_S} s"
            )
        self._info = DutyCycleInfo(
            replay_id=uuid.uuid4().hex,
            cycle=cycle.name,
            cycle_hash=cycle_hash(cycle),
            t0_ns=DEFAULT_T0_NS,
            dt_s=cycle.dt_s,
            steps=len(cycle),
            package_version=__version__,
            command_line=command_line(),
        )
        self._replay = DemandReplay(
            self._info,
            cycle.power_demand_w,
            period_s,
            values["match_timeout_s"],
            values["answer_timeout_s"],
        )
        uneven = f", {trace.irregular} intervals uneven" if trace.irregular else ""
        self._said = f"{cycle.name}, {trace.auxiliaries}{uneven}"
        self._demands = publish_on(node, topics.DUTY_CYCLE_DEMAND, QUEUE)
        self._diagnostics = publish_on(node, topics.DIAGNOSTICS)
        # run_info comes first: callbacks that are ready together run in the order of creation.
        subscribe_to(node, topics.RUN_INFO, self._on_run_info)
        demand = topics.POWER_DEMAND
        subscribe_to(node, replace(demand, qos=replace(demand.qos, depth=QUEUE)), self._on_demand)
        self._announcement = publish_on(node, topics.DUTY_CYCLE_INFO)
        self._announcement.publish(encode(self._info, self._factory)[1])
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        node.create_timer(min(POLL_S, period_s / 4 or POLL_S), self._poll, clock=steady)
        node.create_timer(PERIOD_S, self._diagnose, clock=steady)

    def _publish(self, demands: Iterable[DutyCycleDemand]) -> None:
        for demand in demands:
            self._demands.publish(encode(demand, self._factory)[1])

    def _poll(self) -> None:
        count = self._demands.get_subscription_count()
        self._publish(self._replay.poll(count, time.monotonic()))

    def _on_run_info(self, msg: Any) -> None:
        try:
            self._replay.begin(decode_run_info(msg))
        except BagError as error:
            self._node.get_logger().warning(f"refused: {error}", throttle_duration_sec=1.0)

    def _on_demand(self, msg: Any) -> None:
        try:
            self._replay.observe(decode_power_demand(msg), time.monotonic())
        except BagError as error:
            self._node.get_logger().warning(f"refused: {error}", throttle_duration_sec=1.0)
        else:
            self._poll()

    def _diagnose(self) -> None:
        waiting = self._replay.seen < 0
        state = f"waiting for a plant to drive {self._info.cycle}" if waiting else "playing"
        if waiting:
            self._node.get_logger().info(state, throttle_duration_sec=30.0)
        counters = self._replay.counters
        values = {"cycle": self._info.cycle, "steps": self._info.steps, **counters}
        bad = any(counters[name] for name in ("late", "driven_old", "restarts"))
        self._diagnostics.publish(diagnostic_array(self._node, state, values, warning=bad))

    def finished(self) -> int | None:
        """0 once the plant has driven the last demand.

        Raises:
            RunAborted: another player was there first.
        """
        name = topics.DUTY_CYCLE_DEMAND.name
        count = self._node.count_publishers(self._node.resolve_topic_name(name))
        if count > 1 and self._replay.seen < 0:
            raise RunAborted(
                f"{count} publishers on {name}, allowed 1: another player is there "
                "(a killed one counts for about 20 s)"
            )
        return 0 if self._replay.done else None

    def shutdown(self) -> None:
        """Say how far it came; the plant ends by itself when no more demand comes."""
        shown = ", ".join(f"{name} {value}" for name, value in self._replay.counters.items())
        print(f"bag_player: {self._said}: {self._info.steps} steps, {shown}", flush=True)
