"""Everything that goes wrong on a wire, by name, with the reaction that is expected: one list for
test_faults.py, which asks whether it happens, and measure_reactions.py, which asks how soon."""

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any, Literal

from nodes.scripted import ScriptedPlant, ScriptedPolicy

from tractor_msgs_py import topics
from tractor_msgs_py.ros.messages import RosMessages
from tractor_msgs_py.types import (
    BatteryPowerCommand,
    BatteryReading,
    CommandMode,
    PowerDemand,
    PowertrainReading,
    Reason,
    Sample,
)

PERIOD_S = 0.1
FLOOD_S = 0.001
Reaction = Literal["fallback", "drives on"]


@dataclass(frozen=True)
class PolicyFault:
    """What a policy hears instead of good ticks.

    Attributes:
        name: for people.
        tick: says one faulty tick.
        expected: what the policy does.
        reason, reason_sampled: what its commands then say, by equal stamps and with a map.
        flood: said every millisecond besides.
    """

    name: str
    tick: Callable[[ScriptedPlant], None]
    expected: Reaction = "fallback"
    reason: Reason = Reason.OBSERVATION_STALE
    reason_sampled: Reason = Reason.OBSERVATION_STALE
    flood: Callable[[ScriptedPlant], None] | None = None

    @property
    def drives_on(self) -> bool:
        """No reaction is right."""
        return self.expected == "drives on"


@dataclass(frozen=True)
class PlantFault:
    """What a plant hears instead of one good answer per tick.

    Attributes:
        name: for people.
        answers: commands for a tick.
        expected: what the plant does.
        flood: said every millisecond besides.
    """

    name: str
    answers: Callable[[ScriptedPolicy, int], Iterable[BatteryPowerCommand]]
    expected: Reaction = "fallback"
    flood: Callable[[ScriptedPolicy], None] | None = None

    @property
    def drives_on(self) -> bool:
        """No reaction is right."""
        return self.expected == "drives on"


@dataclass(frozen=True)
class Outcome:
    """What came of a fault.

    Attributes:
        reaction_s: from the last good word to the first sign of the fallback law; None: none.
        reason: what that sign said.
        nominal: part of the faulty ticks that were answered as if nothing was wrong.
        recovery_ticks: good ticks until everything was as before; None: it never was.
        unsafe: commands or powers that were not finite or not feasible.
    """

    reaction_s: float | None
    reason: Reason
    nominal: float
    recovery_ticks: int | None
    unsafe: int


def _changed(kind: type, **values: Any) -> Callable[[Sample], Sample]:
    return lambda s: replace(s, **values) if isinstance(s, kind) else s  # type: ignore[type-var]


def _shifted(by_ns: int, kind: type | None = None) -> Callable[[Sample], Sample]:
    def shift(sample: Any) -> Any:
        if kind is not None and not isinstance(sample, kind):
            return sample
        return replace(sample, stamp_ns=max(sample.stamp_ns + by_ns, 0))

    return shift


def _between(plant: ScriptedPlant) -> None:
    """A demand that belongs to no tick: half a millisecond after the last one, and so on."""
    offset_ns = round((time.monotonic() - plant.said_s) * 1e9)
    plant.peer.say(PowerDemand(plant.run.stamp_ns + offset_ns, 100e3))


def _again(plant: ScriptedPlant) -> None:
    """The present tick's demand once more."""
    plant.peer.say(next(s for s in plant.run.samples() if isinstance(s, PowerDemand)))


HOUR_NS = 3600 * 10**9
DIFFERENT_SAMPLED = {
    "everything stops",
    "power_demand stops",
    "demand is NaN",
    "SOC in percent",
    "stamps from the future",
    "stamps out of order",
    "power_demand floods at 1 kHz, new stamps",
}
"""Faults that a signal map meets with other code; the rest is slow to age and the same."""

POLICY_FAULTS = (
    PolicyFault("everything stops", lambda plant: None),
    PolicyFault("power_demand stops", lambda plant: plant.tick(without=(PowerDemand,))),
    PolicyFault("battery_state stops", lambda plant: plant.tick(without=(BatteryReading,))),
    PolicyFault("powertrain_state stops", lambda plant: plant.tick(without=(PowertrainReading,))),
    PolicyFault("everything freezes, stamps too", lambda plant: plant.repeat()),
    PolicyFault(
        "demand is NaN",
        lambda plant: plant.tick(changed=_changed(PowerDemand, power_w=math.nan)),
    ),
    PolicyFault(
        "SOC is NaN", lambda plant: plant.tick(changed=_changed(BatteryReading, soc=math.nan))
    ),
    PolicyFault(
        "SOC in percent",
        lambda plant: plant.tick(changed=_changed(BatteryReading, soc=80.0)),
        reason_sampled=Reason.OBSERVATION_IMPLAUSIBLE,
    ),
    PolicyFault(
        "SOC jumps",
        lambda plant: plant.tick(changed=_changed(BatteryReading, soc=0.3)),
        reason=Reason.OBSERVATION_IMPLAUSIBLE,
        reason_sampled=Reason.OBSERVATION_IMPLAUSIBLE,
    ),
    PolicyFault("stamps are zero", lambda plant: plant.tick(changed=_shifted(-(10**19)))),
    PolicyFault("stamps from the future", lambda plant: plant.tick(changed=_shifted(HOUR_NS))),
    PolicyFault("stamps from the past", lambda plant: plant.tick(changed=_shifted(-HOUR_NS))),
    PolicyFault("stamps out of order", lambda plant: plant.tick_twisted(), "drives on"),
    PolicyFault(
        "power_demand floods at 1 kHz, new stamps",
        lambda plant: plant.tick(),
        "drives on",
        flood=_between,
    ),
    PolicyFault(
        "power_demand floods at 1 kHz, same stamp",
        lambda plant: plant.tick(),
        "drives on",
        flood=_again,
    ),
)


def _wrong(**values: Any) -> Callable[[ScriptedPolicy, int], Iterable[BatteryPowerCommand]]:
    return lambda policy, stamp_ns: (
        replace(BatteryPowerCommand(stamp_ns, policy.wanted_w), **values),
    )


def _moved(by_ns: int) -> Callable[[ScriptedPolicy, int], Iterable[BatteryPowerCommand]]:
    return lambda policy, stamp_ns: (
        BatteryPowerCommand(max(stamp_ns + by_ns, 0), policy.wanted_w),
    )


def _malformed(policy: ScriptedPolicy, stamp_ns: int) -> tuple[()]:
    message = RosMessages().joint_state(stamp_ns, ["battery_power"], [policy.wanted_w])
    policy.peer.publisher(topics.COMMAND).publish(message)
    return ()


def _old_after_new(policy: ScriptedPolicy, stamp_ns: int) -> tuple[BatteryPowerCommand, ...]:
    old = BatteryPowerCommand(stamp_ns - round(PERIOD_S * 1e9), 2.0 * policy.wanted_w)
    return BatteryPowerCommand(stamp_ns, policy.wanted_w), old


def _repeat(policy: ScriptedPolicy) -> None:
    if policy.demands:
        stamp_ns = policy.demands[-1][1].stamp_ns
        policy.peer.say(BatteryPowerCommand(stamp_ns, policy.wanted_w))


PLANT_FAULTS = (
    PlantFault("commands stop", lambda policy, stamp_ns: ()),
    PlantFault("power is NaN", _wrong(battery_power_w=math.nan)),
    PlantFault("power is infinite", _wrong(battery_power_w=math.inf)),
    PlantFault("power is 1e30 W", _wrong(battery_power_w=1e30)),
    PlantFault("engine power is infinite", _wrong(engine_power_w=math.inf)),
    PlantFault("layout is wrong", _malformed),
    PlantFault("stamps are zero", _moved(-(10**19))),
    PlantFault("stamps from the future", _moved(HOUR_NS)),
    PlantFault("stamps from the past", _moved(-2 * 10**9)),
    PlantFault("stamps out of order", _old_after_new, "drives on"),
    PlantFault(
        "policy says fallback",
        _wrong(mode=CommandMode.FALLBACK, reason=Reason.OBSERVATION_STALE),
    ),
    PlantFault("policy says shutdown", _wrong(mode=CommandMode.SHUTDOWN, reason=Reason.SHUTDOWN)),
    PlantFault(
        "commands flood at 1 kHz",
        lambda policy, stamp_ns: policy.good(stamp_ns),
        "drives on",
        flood=_repeat,
    ),
)


def _wait(graph: Any, end_s: float, flood: Callable[[], None] | None) -> None:
    while flood is not None and time.monotonic() < end_s:
        flood()
        graph.spin_to(time.monotonic() + FLOOD_S)
    graph.spin_to(end_s)


def try_policy(graph: Any, plant: ScriptedPlant, fault: PolicyFault, patience_s: float) -> Outcome:
    """A new run, good ticks, the fault until the policy falls back or ``patience_s`` is over,
    then good ticks again."""
    plant.begin()
    plant.drive_until_nominal(graph.spin_to)
    plant.drive(graph.spin_to, 5)
    graph.spin_until(lambda: plant.nominal, "an answer to the last tick")
    last_s, before = plant.said_s, len(plant.commands)
    nominal, ticks, flood = 0, 0, fault.flood
    while time.monotonic() < last_s + patience_s and not plant.fell_back(before):
        _wait(graph, plant.next_s(), None if flood is None else lambda: flood(plant))
        nominal, ticks = nominal + plant.nominal, ticks + 1
        fault.tick(plant)
    fallen = plant.fell_back(before)
    try:
        recovered: int | None = plant.drive_until_nominal(graph.spin_to)
    except AssertionError:
        recovered = None
    return Outcome(
        fallen[0][0] - last_s if fallen else None,
        fallen[0][1].reason if fallen else Reason.NONE,
        nominal / max(ticks, 1),
        recovered,
        plant.unsafe,
    )


def try_plant(graph: Any, policy: ScriptedPolicy, fault: PlantFault, patience_s: float) -> Outcome:
    """Good answers, the fault until the plant falls back or ``patience_s`` is over, then good
    ones again; on a cycle of constant demand."""
    graph.spin_until(lambda: policy.obeyed, "an obeyed command")
    graph.spin_to(time.monotonic() + 3 * PERIOD_S)
    first, last_s, last_ns = len(policy.applied), policy.said_s, policy.said_ns
    policy.answers = lambda stamp_ns: fault.answers(policy, stamp_ns)
    flood = fault.flood
    while time.monotonic() < last_s + patience_s and not policy.disobeyed(first, last_ns):
        due_s = time.monotonic() + PERIOD_S
        _wait(graph, due_s, None if flood is None else lambda: flood(policy))
    lost, during = policy.disobeyed(first, last_ns), policy.applied[first:]
    policy.answers = policy.good
    count = len(policy.demands)
    deadline_s = time.monotonic() + 60 * PERIOD_S
    graph.spin_until(lambda: policy.obeyed or time.monotonic() > deadline_s, "recovery")
    return Outcome(
        lost[0][0] - last_s if lost else None,
        Reason.NONE,
        sum(policy.obeys(reading) for _, reading in during) / max(len(during), 1),
        len(policy.demands) - count if policy.obeyed else None,
        sum(not policy.lawful(reading) for _, reading in during),
    )
