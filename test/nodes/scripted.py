"""A plant and a policy as a test wants them, said through the wire to a real node on the other
side. They tick and answer when told to, well or badly; no process and no fixture in here."""

import math
import random
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from tractor_msgs_py import topics
from tractor_msgs_py.types import (
    BatteryPowerCommand,
    BatteryReading,
    CommandMode,
    PowerDemand,
    PowertrainReading,
    Sample,
)
from tractor_sim.plant_run import PlantRun, prepare_run

TENTH = "paper:dt_s=0.1"
"""A powertrain without ramp and start fuel, in steps of a tenth of a second."""

SOC = 0.8

OBSERVATION = (PowerDemand, BatteryReading, PowertrainReading)


def write_cycle(path: Path, power_w: Iterable[float], dt_s: float) -> str:
    """A cycle file whose steps are ``dt_s`` long."""
    rows = "".join(f"{k * dt_s:.6g},{power!r}\n" for k, power in enumerate(map(float, power_w)))
    path.write_text("time_s,power_demand_w\n" + rows)
    return str(path)


class ScriptedPlant:
    """The plant's side of a real-time run; ticks follow one another as fast as it is told.

    Attributes:
        run: what is driven now.
        commands: everything heard since the run began, with the time of hearing [s].
        said_s: when the last observation was published.
    """

    def __init__(self, peer: Any, cycle: str, powertrain: str = TENTH) -> None:
        self._peer, self._what = peer, (powertrain, cycle)
        self.commands: list[tuple[float, BatteryPowerCommand]] = []
        self.said_s = 0.0
        peer.on_sample = self._hear
        self.run: PlantRun = self._new("real_time")

    def _new(self, mode: Any) -> PlantRun:
        return prepare_run(*self._what, soc_initial=SOC, soc_target=SOC, mode=mode)

    def _hear(self, sample: Any) -> None:
        if isinstance(sample, BatteryPowerCommand):
            self.commands.append((time.monotonic(), sample))

    def begin(self, mode: str = "real_time") -> None:
        """Announce a new run; its first tick is still to come."""
        self.run, self._told = self._new(mode), False
        self.commands.clear()
        self._peer.say(self.run.info)

    def tick(
        self,
        without: tuple[type, ...] = (),
        changed: Callable[[Sample], Sample] = lambda sample: sample,
    ) -> None:
        """Drive the present step with the newest command, then publish the next tick.

        Args:
            without: kinds of sample that are left out.
            changed: what becomes of each sample on its way.
        """
        if self._told:
            newest = self.commands[-1][1] if self.commands else None
            wanted_w = newest.battery_power_w if newest is not None else 0.0
            self.run.apply(BatteryPowerCommand(self.run.stamp_ns, wanted_w))
        self._told = True
        self._peer.say(*(changed(s) for s in self.run.samples() if not isinstance(s, without)))
        self.said_s = time.monotonic()

    def drive(self, spin_to: Callable[[float], None], ticks: int, period_s: float) -> None:
        """``ticks`` good ticks, one per period; returns right after the last was published."""
        due_s = time.monotonic()
        for k in range(ticks):
            if k:
                due_s += period_s
                spin_to(due_s)
            self.tick()

    @property
    def nominal(self) -> bool:
        """The newest command is the policy's own wish, for the present tick."""
        if not self.commands:
            return False
        newest = self.commands[-1][1]
        return newest.mode is CommandMode.NOMINAL and newest.stamp_ns == self.run.stamp_ns

    @property
    def fallback(self) -> bool:
        """The newest command is none that a policy would want."""
        return bool(self.commands) and self.commands[-1][1].mode is not CommandMode.NOMINAL

    def first_fallback_s(self) -> float:
        """When the first such command of the run was heard [s]."""
        return next(at for at, said in self.commands if said.mode is not CommandMode.NOMINAL)

    def safe(self, command: BatteryPowerCommand) -> bool:
        """Finite and within what battery and engine can do at the present tick."""
        lb, ub = self.run.feasible_w()
        return math.isfinite(command.battery_power_w) and (
            lb - 1.0 <= command.battery_power_w <= ub + 1.0
        )


class ScriptedPolicy:
    """The policy's side: answers each tick with the same battery power, unless told otherwise.

    Attributes:
        wanted_w: what it asks of the battery [W].
        answers: makes the commands for a tick; empty for silence.
        applied: readings of what the plant did, with the time of hearing [s].
        demands: every tick heard, with the time of hearing [s].
        said_s, said_ns: when the last command was published, and the tick that it answered.
    """

    def __init__(self, peer: Any, wanted_w: float = 20e3) -> None:
        self._peer, self.wanted_w = peer, wanted_w
        self.answers: Callable[[int], Iterable[BatteryPowerCommand]] = self.good
        self.applied: list[tuple[float, PowertrainReading]] = []
        self.demands: list[tuple[float, PowerDemand]] = []
        self.said_s, self.said_ns = 0.0, 0
        peer.on_sample = self._hear
        peer.publisher(topics.COMMAND)

    def good(self, stamp_ns: int) -> Iterable[BatteryPowerCommand]:
        """The one command that is right."""
        return (BatteryPowerCommand(stamp_ns, self.wanted_w),)

    def silent(self, stamp_ns: int) -> Iterable[BatteryPowerCommand]:
        """No answer at all."""
        return ()

    def _hear(self, sample: Any) -> None:
        if isinstance(sample, PowertrainReading):
            self.applied.append((time.monotonic(), sample))
        if not isinstance(sample, PowerDemand):
            return
        self.demands.append((time.monotonic(), sample))
        commands = tuple(self.answers(sample.stamp_ns))
        if commands:
            self.said_ns, self.said_s = sample.stamp_ns, time.monotonic()
            self._peer.say(*commands)

    @property
    def obeyed(self) -> bool:
        """The plant's last step was driven as it was asked."""
        return bool(self.applied) and self.obeys(self.applied[-1][1])

    def obeys(self, reading: PowertrainReading) -> bool:
        """A step was driven as it was asked."""
        return abs(reading.applied_battery_power_w - self.wanted_w) < 1.0


def random_demand(seed: int, steps: int) -> list[float]:
    """Work without any pattern, at least engine and battery can always do it [W]."""
    rng = random.Random(seed)
    return [round(rng.uniform(60e3, 180e3), 1) for _ in range(steps)]
