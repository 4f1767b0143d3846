"""A policy that is stopped, resumed, killed and replaced, and a plant that is killed and replaced,
all of them real: how long until the other side noticed, and until it drove again."""

import signal
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from nodes.scripted import SOC, TENTH, random_demand, write_cycle
from nodes.stage import Stage

from tractor_msgs_py import topics
from tractor_msgs_py.types import BatteryPowerCommand, CommandMode, PowertrainReading, RunInfo

WATCHED = (topics.RUN_INFO, topics.POWERTRAIN, topics.COMMAND)


@dataclass
class Watched:
    """What the two say to each other, with the time of hearing [s].

    Attributes:
        steps: what the plant did.
        commands: what the policy said.
        runs: runs by id, in order.
    """

    steps: list[tuple[float, PowertrainReading]] = field(default_factory=list)
    commands: list[tuple[float, BatteryPowerCommand]] = field(default_factory=list)
    runs: list[str] = field(default_factory=list)

    def hear(self, sample: Any) -> None:
        """Keep one sample."""
        now_s = time.monotonic()
        if isinstance(sample, PowertrainReading):
            self.steps.append((now_s, sample))
        elif isinstance(sample, BatteryPowerCommand):
            self.commands.append((now_s, sample))
        elif isinstance(sample, RunInfo) and sample.run_id not in self.runs:
            self.runs.append(sample.run_id)

    def undriven(self, since_s: float) -> float | None:
        """When the first step without any battery power was heard after ``since_s``."""
        return _first(self.steps, since_s, lambda step: step.applied_battery_power_w == 0.0)

    def driven(self, since_s: float) -> float | None:
        """When the first step with battery power was heard after ``since_s``."""
        return _first(self.steps, since_s, lambda step: step.applied_battery_power_w != 0.0)

    def given_up(self, since_s: float) -> float | None:
        """When the first fallback command was heard after ``since_s``."""
        return _first(self.commands, since_s, lambda command: command.mode is CommandMode.FALLBACK)


def _first(heard: list[tuple[float, Any]], since_s: float, is_it: Callable[[Any], bool]) -> Any:
    return next((at for at, sample in heard if at > since_s and is_it(sample)), None)


def lose_and_replace(on: Stage, timeout_s: float) -> dict[str, float]:
    """Go through all of it once; seconds from each cause to its effect, by what happened.

    Args:
        on: where.
        timeout_s: of both sides [s].
    """
    graph, seen = on.graph, Watched()
    # Light work, which the rule leaves to the battery alone: only the fallback law asks for 0.
    cycle = write_cycle(on.folder / "light.csv", random_demand(1, 6000, 60e3, 100e3), 0.1)
    peer = graph.peer(*WATCHED, name="watcher", namespace="/lost")
    peer.on_sample = seen.hear

    def policy() -> Any:
        return on.start(
            "rule_based_policy", "/lost", powertrain=TENTH, observation_timeout_s=timeout_s
        )

    def plant() -> Any:
        return on.start(
            "plant_sim", "/lost", powertrain=TENTH, cycle=cycle, mode="real_time",
            command_timeout_s=timeout_s, soc_initial=SOC,
        )  # fmt: skip

    took: dict[str, float] = {}

    def until(what: str, effect: Callable[[float], float | None], cause_s: float) -> None:
        graph.spin_until(lambda: effect(cause_s) is not None, what)
        at_s = effect(cause_s)
        assert at_s is not None
        took[what] = at_s - cause_s

    driver, vehicle = policy(), plant()
    graph.spin_until(lambda: seen.driven(0.0), "the first driven step")
    graph.spin_to(time.monotonic() + 2 * timeout_s)

    driver.process.send_signal(signal.SIGSTOP)
    until("policy SIGSTOPped: plant falls back", seen.undriven, time.monotonic())
    graph.spin_to(time.monotonic() + 2 * timeout_s)
    driver.process.send_signal(signal.SIGCONT)
    until("policy resumed: it drives again", seen.driven, time.monotonic())

    vehicle.end(signal.SIGKILL)
    until("plant SIGKILLed: policy falls back", seen.given_up, time.monotonic())
    vehicle, started_s = plant(), time.monotonic()
    until("plant started anew: policy drives it", seen.driven, started_s)

    driver.end(signal.SIGKILL)
    until("policy SIGKILLed: plant falls back", seen.undriven, time.monotonic())
    driver, started_s = policy(), time.monotonic()
    until("policy started anew: it drives again", seen.driven, started_s)

    for node in (driver, vehicle):
        assert on.end(node) == 0, node.output
        assert "Traceback" not in node.output
    assert len(seen.runs) == 2
    graph.remove(peer.node)
    return took
