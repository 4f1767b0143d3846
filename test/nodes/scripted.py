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

MOST_TICKS = 300
"""Good ticks, half a minute at 10 Hz, after which a policy must have been found and drive."""

OBSERVATION = (PowerDemand, BatteryReading, PowertrainReading)


def write_cycle(path: Path, power_w: Iterable[float], dt_s: float) -> str:
    """A cycle file whose steps are ``dt_s`` long."""
    rows = "".join(f"{k * dt_s:.6g},{power!r}\n" for k, power in enumerate(map(float, power_w)))
    path.write_text("time_s,power_demand_w\n" + rows)
    return str(path)


class ScriptedPlant:
    """The plant's side of a run in real time: a tick comes when it is told to, its stamp is what
    the wall clock says, to the nearest step.

    Args:
        peer: says and hears.
        cycle, powertrain: what to drive.
        period_s: wall time of a step, None for the powertrain's [s].

    Attributes:
        run: what is driven now.
        commands: everything heard since the run began, with the time of hearing [s].
        said_s: when the last observation was published.
        unsafe: commands that were not finite or not feasible at the tick they answered.
    """

    def __init__(
        self, peer: Any, cycle: str, powertrain: str = TENTH, period_s: float | None = None
    ) -> None:
        self.peer, self._what = peer, (powertrain, cycle)
        self.commands: list[tuple[float, BatteryPowerCommand]] = []
        self.said_s, self.unsafe = 0.0, 0
        self._bounds: dict[int, tuple[float, float]] = {}
        peer.on_sample = self._hear
        self.run: PlantRun = self._new("real_time")
        self._period_s = self.run.info.dt_s if period_s is None else period_s
        self._begun_s: float | None = None

    def _new(self, mode: Any) -> PlantRun:
        return prepare_run(*self._what, soc_initial=SOC, soc_target=SOC, mode=mode)

    def _hear(self, sample: Any) -> None:
        if isinstance(sample, BatteryPowerCommand):
            self.commands.append((time.monotonic(), sample))
            self.unsafe += not self.safe(sample)

    def begin(self, mode: str = "real_time") -> None:
        """Announce a new run; its first tick is still to come."""
        self.run, self._begun_s, self.unsafe = self._new(mode), None, 0
        self._bounds.clear()
        self.commands.clear()
        self.peer.say(self.run.info)

    def tick(
        self,
        without: tuple[type, ...] = (),
        changed: Callable[[Sample], Sample] = lambda sample: sample,
    ) -> None:
        """Drive the steps that are over with the newest command, then publish the next tick.

        Args:
            without: kinds of sample that are left out.
            changed: what becomes of each sample on its way.
        """
        if self._begun_s is None:
            self._begun_s = time.monotonic()
        else:
            wanted_w = self.commands[-1][1].battery_power_w if self.commands else 0.0
            passed_s = time.monotonic() - self._begun_s
            for _ in range(max(round(passed_s / self._period_s) - self.run.k, 1)):
                self.run.apply(BatteryPowerCommand(self.run.stamp_ns, wanted_w))
        self._bounds[self.run.stamp_ns] = self.run.feasible_w()
        self.peer.say(*(changed(s) for s in self.run.samples() if not isinstance(s, without)))
        self.said_s = time.monotonic()

    def repeat(self) -> None:
        """Publish the present tick once more."""
        self.peer.say(*self.run.samples())

    def tick_twisted(self) -> None:
        """A tick whose predecessor is said again after it."""
        before = self.run.samples()
        self.tick()
        self.peer.say(*before)

    def next_s(self) -> float:
        """When the next tick is due."""
        begun_s = time.monotonic() if self._begun_s is None else self._begun_s
        late = math.floor((time.monotonic() - begun_s) / self._period_s)
        return begun_s + (max(self.run.k, late) + 1) * self._period_s

    def drive(self, spin_to: Callable[[float], None], ticks: int) -> None:
        """``ticks`` good ticks, each when it is due; returns right after the last."""
        for _ in range(ticks):
            spin_to(self.next_s() if self._begun_s is not None else 0.0)
            self.tick()

    def drive_until_nominal(self, spin_to: Callable[[float], None]) -> int:
        """Good ticks until the policy drives, at least one; how many.

        Raises AssertionError where it does not within :data:`MOST_TICKS`.
        """
        for ticks in range(1, MOST_TICKS + 1):
            self.drive(spin_to, 1)
            spin_to(self.next_s() - 0.01)
            if self.nominal:
                return ticks
        raise AssertionError(f"no policy drives after {MOST_TICKS} good ticks")

    @property
    def nominal(self) -> bool:
        """The newest command is the policy's own wish, for the present tick or the last: signals
        that are sampled may have come just after the policy's own tick."""
        if not self.commands:
            return False
        newest, present = self.commands[-1][1], self.run
        age_ns = present.stamp_ns - newest.stamp_ns
        return newest.mode is CommandMode.NOMINAL and age_ns <= present.info.dt_ns

    def fell_back(self, first: int) -> list[tuple[float, BatteryPowerCommand]]:
        """Commands from the ``first`` one on that are none a policy would want."""
        return [c for c in self.commands[first:] if c[1].mode is not CommandMode.NOMINAL]

    def safe(self, command: BatteryPowerCommand) -> bool:
        """Finite and within what battery and engine could do at the tick it answers, or at one
        in the second before, for a policy that knows no newer demand."""
        power_w, at_ns = command.battery_power_w, command.stamp_ns
        known = [b for s, b in self._bounds.items() if at_ns - 1_000_000_000 <= s <= at_ns]
        return math.isfinite(power_w) and (
            not known or any(lb - 1.0 <= power_w <= ub + 1.0 for lb, ub in known)
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
        self.peer, self.wanted_w = peer, wanted_w
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
            self.peer.say(*commands)

    @property
    def obeyed(self) -> bool:
        """The plant's last step was driven as it was asked."""
        return bool(self.applied) and self.obeys(self.applied[-1][1])

    def obeys(self, reading: PowertrainReading) -> bool:
        """A step was driven as it was asked."""
        return abs(reading.applied_battery_power_w - self.wanted_w) < 1.0

    def lawful(self, reading: PowertrainReading) -> bool:
        """A step was driven as it was asked, by the fallback law, or on the way between them."""
        return -1.0 <= reading.applied_battery_power_w <= self.wanted_w + 1.0

    def disobeyed(self, first: int, after_ns: int) -> list[tuple[float, PowertrainReading]]:
        """Steps from the ``first`` reading on, later than a stamp, that were driven otherwise."""
        return [
            a for a in self.applied[first:] if a[1].stamp_ns > after_ns and not self.obeys(a[1])
        ]


def random_demand(
    seed: int, steps: int, low_w: float = 60e3, high_w: float = 180e3
) -> list[float]:
    """Work without any pattern, which engine and battery can always do [W]."""
    rng = random.Random(seed)
    return [round(rng.uniform(low_w, high_w), 1) for _ in range(steps)]
