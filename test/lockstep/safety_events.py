"""Both sides of the safety core under any events, with an oracle that checks every power.

The hypothesis machine and ``million_events`` choose the events. The oracle is written out in
plain floats, from the definitions and not from the code under test.
"""

import math
from collections import Counter
from dataclasses import replace

import numpy as np

from tractor_ems.plausible import Seen, judge, plausible_on
from tractor_ems.safety import (
    fallback_command,
    generator_set_point_w,
    safe_command,
    vehicle_command,
    vehicle_fallback,
    within_powertrain,
)
from tractor_msgs_py import supervisor
from tractor_msgs_py.observation import Observation
from tractor_msgs_py.supervisor import Condition, SupervisorConfig
from tractor_msgs_py.types import DEFAULT_T0_NS, BatteryPowerCommand, CommandMode, Reason, RunInfo
from tractor_sim.config import load_powertrain
from tractor_sim.pace import Peers
from tractor_sim.plant_run import PlantRun
from tractor_sim.powertrain import Command, PowertrainParams
from tractor_sim.real_time import RealTime
from tractor_sim.safe_command import ramp_limit

ROUNDING_W = 1e-3
MODES = (CommandMode.FALLBACK, CommandMode.SHUTDOWN)
EVERYONE = Peers(command_publishers=1, observation_subscribers=1, run_info_delivered=True)


def small(params: PowertrainParams) -> PowertrainParams:
    """The powertrain with a battery so small that both ends of its window are met often."""
    return replace(params, battery=replace(params.battery, energy_j=5e6))


POWERTRAINS = {name: small(load_powertrain(name)) for name in ("paper", "field")}


def corners_w(lb_w: float, ub_w: float, params: PowertrainParams) -> tuple[float, float]:
    """[lb, ub], or the battery's nearest limit where they leave no choice."""
    if lb_w <= ub_w:
        return lb_w, ub_w
    most_w = params.battery.power_max_w
    return min(ub_w, most_w), max(min(lb_w, most_w), ub_w)


def allowed_change_w(before_w, change_w, demand_w, lb_w, ub_w) -> float:
    """The most that P_gen may move: the ramp, or what feasibility forces."""
    least_w, most_w = max(demand_w - ub_w, 0.0), max(demand_w - lb_w, 0.0)
    if least_w > most_w:  # no choice is left: either end may be forced
        return max(change_w, abs(least_w - before_w), abs(most_w - before_w))
    nearest_w = min(max(before_w, least_w), most_w)
    return max(change_w, abs(nearest_w - before_w))


class PlantSide:
    """A plant in real time and everything that can happen to it.

    Attributes:
        counts: events by kind, and what became of the ticks.
    """

    def __init__(
        self, powertrain: str, demand_w, period_s=0.5, timeout_s=1.2, recover=1, ramp_w_per_s=0.0
    ) -> None:
        self.counts: Counter[str] = Counter()
        self._args = (powertrain, demand_w, period_s, timeout_s, recover, ramp_w_per_s)
        self.now_s = 50.0
        self.restart()

    def restart(self) -> None:
        """A new run: nothing of the old one is trusted."""
        name, demand_w, self.period_s, self.timeout_s, self.recover, self.ramp = self._args
        self.params = POWERTRAINS[name]
        info = RunInfo(
            "run", "cycle", "", name, "", DEFAULT_T0_NS, self.params.dt_s, len(demand_w), 0.0,
            self.params.soc_initial, self.params.soc_initial, lockstep=False,
        )  # fmt: skip
        self.run = PlantRun(self.params, info, np.array(demand_w))
        settings = {"recover_after": self.recover, "ramp_w_per_s": self.ramp}
        self.plant = RealTime(self.run, self.period_s, self.timeout_s, **settings)
        self.plant.start(EVERYONE, self.now_s)
        self.published_s = {0: self.now_s}
        self.good_tick: int | None = None
        self.newest_tick = 0
        self.counts["restart"] += 1

    def say(self, kind: str, battery_w: float, engine_w: float = math.nan, back: int = 0) -> None:
        """A command of one kind, answering the tick ``back`` ticks ago."""
        info, tick = self.run.info, self.run.k - back
        stamp_ns, mode, publishers = info.stamp_ns(tick), CommandMode.NOMINAL, 1
        match kind:
            case "future":
                stamp_ns = info.stamp_ns(self.run.k + 1 + back)
            case "other_run":
                stamp_ns += 1 + back
            case "zero_stamp":
                stamp_ns = 0
            case "fallback_mode" | "shutdown_mode":
                mode = MODES[kind == "shutdown_mode"]
            case "two_publishers":
                publishers = 2
        self.counts[kind] += 1
        command = BatteryPowerCommand(stamp_ns, battery_w, engine_w, mode)
        refused = self.plant.refusals.total() - self.plant.refusals["flood"]
        self.plant.offer(command, publishers, self.now_s)
        accepted = self.plant.refusals.total() - self.plant.refusals["flood"] == refused
        self.counts["accepted" if accepted else "refused"] += 1
        most_w = self.params.engine.power_max_w + self.params.battery.power_max_w
        sound = math.isfinite(battery_w) and abs(battery_w) <= most_w and not math.isinf(engine_w)
        age_s = self.now_s - self.published_s.get(tick, -math.inf)
        if accepted:
            assert kind in ("good", "wild") and sound, (kind, battery_w, engine_w)
            assert age_s <= self.timeout_s + 1e-9, age_s
            assert tick >= self.newest_tick
            self.good_tick = self.newest_tick = tick
        elif kind in ("fallback_mode", "shutdown_mode", "two_publishers"):
            self.good_tick = None
        elif kind == "good" and sound and not self.plant.done:  # nothing but its age is wrong
            assert age_s >= self.timeout_s - 1e-9 or tick < self.newest_tick, age_s

    def tick(self, after_s: float = 0.0, publishers: int = 1) -> None:
        """Time goes on to the next step, or ``after_s`` beyond it; what was applied is judged."""
        self.counts["tick" if publishers == 1 else "tick_with_two_publishers"] += 1
        self.now_s = max(self.now_s, self.plant._due_s + after_s)
        if publishers > 1:
            self.good_tick = None
        k, falls = self.run.k, self.plant.fallback_ticks
        lb_w, ub_w = self.run.feasible_w()
        before_w = self.plant._generator_w
        self.plant.poll(publishers, self.now_s)
        assert self.run.k == k + 1
        self.published_s[k + 1] = self.now_s
        self.judge(lb_w, ub_w, before_w)
        fell = self.plant.fallback_ticks > falls
        self.counts["fallback" if fell else "nominal"] += 1
        heard_s = self.published_s[self.good_tick] if self.good_tick is not None else -math.inf
        if self.now_s - heard_s > self.timeout_s + 1e-9:
            assert fell, "nothing fresh was there to obey"
        if self.recover == 1 and self.now_s - heard_s < self.timeout_s - 1e-9:
            assert not fell, "a fresh command was not obeyed"
        if self.plant.done:
            self.restart_after_end()

    def restart_after_end(self) -> None:
        """The run is over: late commands change nothing, then a new run begins."""
        self.plant.offer(BatteryPowerCommand(self.run.info.stamp_ns(0), 0.0), 1, self.now_s)
        assert self.run.done
        self.restart()

    def judge(self, lb_w: float, ub_w: float, before_w: float) -> None:
        """What was applied over the last step."""
        row = self.run._rows[-1]
        demand_w, battery_w, engine_w = row[0], row[4], row[5]
        assert all(math.isfinite(value) for n, value in enumerate(row) if n != 3), row
        low_w, high_w = corners_w(lb_w, ub_w, self.params)
        assert low_w - ROUNDING_W <= battery_w <= high_w + ROUNDING_W, (row, lb_w, ub_w)
        assert abs(battery_w) <= self.params.battery.power_max_w + ROUNDING_W
        soc = float(self.run._state.soc[0])
        assert self.params.battery.soc_min <= soc <= self.params.battery.soc_max, soc
        assert 0.0 <= engine_w <= self.params.engine.power_max_w + ROUNDING_W
        if self.ramp:
            change_w = self.ramp * self.params.dt_s
            most_w = allowed_change_w(before_w, change_w, demand_w, lb_w, ub_w)
            assert abs(engine_w - before_w) <= most_w + ROUNDING_W, (row, before_w, lb_w, ub_w)


class PolicySide:
    """The pure functions of the policy's side, in the order in which a node calls them."""

    def __init__(self, powertrain: str, ramp_w_per_s: float = 0.0, dt_s: float = 0.5) -> None:
        self.counts: Counter[str] = Counter()
        self.params, self.ramp, self.dt_s = POWERTRAINS[powertrain], ramp_w_per_s, dt_s
        self.allowed = plausible_on(self.params)
        self.config = SupervisorConfig(timeout_s=2.0 * dt_s, recover_after=3, fault_after=8)
        self.now_s, self.stamp_ns = 10.0, DEFAULT_T0_NS
        self.restart()

    def restart(self) -> None:
        """A new run or a new engagement."""
        self.counts["restart"] += 1
        self.trust, self.seen = supervisor.reset(), Seen()
        self.before_w: float = math.nan

    def silence(self, periods: int) -> None:
        """Nothing is observed; trust must end with the timeout."""
        self.counts["silence"] += 1
        self.now_s += periods * self.dt_s
        self.trust = supervisor.elapsed(self.config, self.trust, self.now_s)
        age_s = self.now_s - self.trust.good_s
        assert not (self.trust.nominal and age_s > self.config.timeout_s)

    def observe(self, values: dict[str, float], battery_w: float, engine_w: float) -> None:
        """An observation, and what the policy says to it; what is sent is judged."""
        self.counts["observation"] += 1
        self.now_s += self.dt_s
        self.stamp_ns += round(self.dt_s * 1e9)
        arrays = {name: np.array([value]) for name, value in values.items()}
        raw = Observation(
            stamp_ns=self.stamp_ns,
            soc_target=np.array([0.5]),
            engine_on=np.array([values["engine_power_w"] > 1e3]),
            features=np.zeros((1, 0)),
            **arrays,
        )
        observation = within_powertrain(raw, self.params, self.dt_s)
        self.seen, found = judge(self.allowed, self.seen, raw)
        if found is None:
            self.trust = supervisor.good(self.config, self.trust, self.now_s)
        else:
            self.counts["implausible"] += 1
            self.trust = supervisor.bad(self.config, self.trust, self.now_s, found.reason)
        wish = Command(np.array([battery_w]), np.array([engine_w]))
        ramp = ramp_limit(self.before_w, self.ramp, self.dt_s)
        if self.trust.nominal and found is None:
            self.counts["nominal"] += 1
            command, _ = vehicle_command(observation, wish, ramp)
        else:
            self.counts[f"fallback_{self.trust.condition.name.lower()}"] += 1
            reason = supervisor.command_reason(self.trust) or Reason.OBSERVATION_IMPLAUSIBLE
            command = vehicle_fallback(observation, reason, ramp=ramp)
        self.judge(observation, command)
        set_point_w = generator_set_point_w(observation, command)
        if math.isfinite(values["power_demand_w"]):
            assert 0.0 <= set_point_w <= self.params.engine.power_max_w
            self.before_w = set_point_w
        else:
            assert math.isnan(set_point_w) and command.battery_power_w == 0.0
        if self.trust.condition is Condition.FAULT and self.counts["observation"] % 5 == 0:
            self.restart()
        self.simulator(raw, wish)

    def judge(self, observation: Observation, command: BatteryPowerCommand) -> None:
        """What is sent lies within the observation's limits, and on the ramp."""
        demand_w = float(observation.power_demand_w[0])
        demand_w = demand_w if math.isfinite(demand_w) else 0.0
        charge_w, discharge_w, engine_w = (
            float(getattr(observation, name)[0])
            for name in ("charge_limit_w", "discharge_limit_w", "engine_limit_w")
        )
        assert 0.0 <= charge_w <= self.params.battery.power_max_w
        assert 0.0 <= discharge_w <= self.params.battery.power_max_w
        assert 0.0 <= engine_w <= self.params.engine.power_max_w
        least_w, most_w = max(-charge_w, demand_w - engine_w), min(discharge_w, demand_w)
        lb_w, ub_w = corners_w(least_w, most_w, self.params)
        sent_w = command.battery_power_w
        assert math.isfinite(sent_w) and not math.isinf(command.engine_power_w), command
        assert lb_w <= sent_w <= ub_w, (command, lb_w, ub_w)
        assert -charge_w <= sent_w <= discharge_w, (command, charge_w, discharge_w)
        assert (command.mode is CommandMode.NOMINAL) == (command.reason is Reason.NONE)
        known = math.isfinite(float(observation.power_demand_w[0]))
        if self.ramp and known and math.isfinite(self.before_w):
            change_w = self.ramp * self.dt_s
            most_w = allowed_change_w(self.before_w, change_w, demand_w, least_w, most_w)
            moved_w = abs(min(max(demand_w - sent_w, 0.0), engine_w) - self.before_w)
            assert moved_w <= most_w + ROUNDING_W, (command, self.before_w, lb_w, ub_w)

    def simulator(self, observation: Observation, wish: Command) -> None:
        """With limits and demand as a plant publishes them the older functions hold as well."""
        names = ("charge_limit_w", "discharge_limit_w", "engine_limit_w")
        limits_w = [float(getattr(observation, name)[0]) for name in names]
        demand_w = float(observation.power_demand_w[0])
        if not abs(demand_w) <= 1e9 or not all(0.0 <= w <= 1e9 for w in limits_w):
            return
        self.counts["simulator"] += 1
        charge_w, discharge_w, most_w = limits_w
        lb_w = max(-charge_w, demand_w - most_w)
        ub_w = max(lb_w, min(discharge_w, demand_w))
        for command in (
            safe_command(observation, wish)[0],
            fallback_command(observation, CommandMode.FALLBACK),
        ):
            assert lb_w <= command.battery_power_w <= ub_w
            assert not math.isinf(command.engine_power_w)
