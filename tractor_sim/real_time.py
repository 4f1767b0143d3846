"""When the plant steps in real time: on a wall clock, with the newest command that is fresh.

Pure like its sibling ``lockstep``. The supervisor says whether the policy is trusted; where it
is not, the fallback law holds: zero battery power, projected on the feasible set. A dead or
doubled policy never stops the plant.
"""

import math
from collections import Counter
from dataclasses import replace

import numpy as np

from tractor_msgs_py import supervisor
from tractor_msgs_py.supervisor import SupervisorConfig
from tractor_msgs_py.types import BatteryPowerCommand, CommandMode, Reason, Sample
from tractor_sim.pace import Pace
from tractor_sim.plant_run import PlantRun
from tractor_sim.powertrain import Command
from tractor_sim.safe_command import lawful, ramp_limit

FLOOD_PER_PERIOD = 20
"""A policy that answers more often than this in one step floods: only its newest answer counts,
as always, and those above are counted."""

STAMP_GRID_NS = 1_000_000
"""A policy of another rate than the plant's ticks at whole milliseconds since the run's start."""


def held_command(
    command: BatteryPowerCommand, stamp_ns: int, demand_then_w: float, demand_now_w: float
) -> BatteryPowerCommand:
    """``command`` answered another tick: its generator set-point is held, the battery is the
    slack of the demand that has changed since."""
    if command.stamp_ns == stamp_ns:
        return command
    set_point_w = 0.0 if command.engine_power_w == 0.0 else demand_then_w - command.battery_power_w
    return BatteryPowerCommand(stamp_ns, demand_now_w - set_point_w, command.engine_power_w)


class RealTime(Pace):
    """The plant's side in real time.

    A step over [t_k, t_k+1) is taken when it is over. A command's age is the wall time since the
    tick that it answers was published, so a policy that lags counts as stale like a dead one.
    While two policies are connected neither is obeyed; one that was killed counts as connected
    until the middleware's lease ends, about 20 s.

    Refused commands never latch FAULT here: they are not applied, and a policy that is started
    anew must find a plant that listens.

    Args:
        run: what is driven.
        period_s: wall time of one step, > 0 [s].
        command_timeout_s: oldest command obeyed, > 0 [s].
        match_timeout_s: how long to wait for a policy, 0 for ever [s].
        recover_after: good commands in a row, of different ticks, until a policy that was lost is
            obeyed again, >= 1.
        ramp_w_per_s: most change of the generator's set-point, >= 0; 0: what the powertrain
            itself allows. It holds for every step, so also when the fallback law takes over or
            ends [W/s].

    Attributes:
        fallback_ticks: steps driven by the fallback law.
        fallback_reasons: the same by reason.
        trust: the supervisor's state.

    Raises ConfigError where a setting is out of range.
    """

    def __init__(
        self,
        run: PlantRun,
        period_s: float,
        command_timeout_s: float,
        match_timeout_s: float = 0.0,
        recover_after: int = 1,
        ramp_w_per_s: float = 0.0,
    ) -> None:
        super().__init__(run, match_timeout_s)
        self.fallback_ticks = 0
        self.fallback_reasons: Counter[Reason] = Counter()
        self.trust = supervisor.reset()
        self._config = SupervisorConfig(
            command_timeout_s,
            recover_after,
            fault_after=0,
            good_every_s=period_s / 2.0,
            stale_reason=Reason.COMMAND_STALE,
        )
        ramp_limit(0.0, ramp_w_per_s, run.info.dt_s)  # refuses what is out of range
        self._ramp_w_per_s = ramp_w_per_s
        # Less is projected on [lb, ub], which a policy that lags cannot know; more is no answer.
        self._most_w = run.params.engine.power_max_w + run.params.battery.power_max_w
        self._generator_w = 0.0
        self._period_s = period_s
        self._timeout_s = command_timeout_s
        self._due_s = 0.0
        self._published_s: dict[int, float] = {}
        self._newest: BatteryPowerCommand | None = None
        self._newest_ns = 0
        self._heard_this_step = 0

    def _own_counters(self) -> dict[str, int | str]:
        reasons = {f"fallback_{r.name.lower()}": n for r, n in self.fallback_reasons.items()}
        return {
            "fallback_ticks": self.fallback_ticks,
            **dict(sorted(reasons.items())),
            "condition": self.trust.condition.name,
            "reason": self.trust.reason.name,
        }

    def _first_tick(self, now_s: float) -> tuple[Sample, ...]:
        self._due_s = now_s
        return self._publish(now_s)

    @property
    def state(self) -> str:
        """What it is doing, for people: the fallback law is no driving."""
        return supervisor.describe(self.trust) if self.started else super().state

    def wait_s(self, now_s: float) -> float:
        """How long until the present step is over [s]."""
        under_way = self.started and not self.done
        return max(self._due_s - now_s, 0.0) if under_way else math.inf

    def poll(self, command_publishers: int, now_s: float) -> tuple[Sample, ...]:
        """Samples of the next tick when the present step's time is over, else nothing.

        A plant that was held up does not rush to catch up: time starts again from now.
        """
        self.trust = supervisor.elapsed(self._config, self.trust, now_s)
        if command_publishers > 1:
            self._lose(Reason.HANDOVER)
        if now_s < self._due_s or self.done:
            return ()
        result = self.run.apply(self._within_ramp(self._command(now_s)))
        self._generator_w = float(result.engine_power_w[0])
        self._heard_this_step = 0
        return self._publish(now_s)

    def offer(
        self, command: BatteryPowerCommand, command_publishers: int, now_s: float
    ) -> tuple[Sample, ...]:
        """A command arrived; it is kept or refused, and nothing is published."""
        self.trust = supervisor.elapsed(self._config, self.trust, now_s)
        reason = self._refusal(command, command_publishers, now_s)
        if reason is None:
            self._keep(command, now_s)
            return ()
        self.refusals[reason] += 1
        if reason == "two_publishers":
            self._lose(Reason.HANDOVER)
        elif reason in ("fallback_mode", "shutdown_mode"):
            said = Reason.SHUTDOWN if reason == "shutdown_mode" else Reason.COMMAND_STALE
            self._lose(command.reason or said)
        elif reason in ("not_finite", "out_of_range", "stale"):
            why = Reason.COMMAND_STALE if reason == "stale" else Reason.POLICY_ERROR
            self.trust = supervisor.bad(self._config, self.trust, now_s, why)
        return ()

    def _keep(self, command: BatteryPowerCommand, now_s: float) -> None:
        self._heard_this_step += 1
        if self._heard_this_step > FLOOD_PER_PERIOD:
            self.refusals["flood"] += 1  # the one that this one replaces
        self._newest, self._newest_ns = command, command.stamp_ns
        answered_s = min(self._published_at(command.stamp_ns), now_s)
        self.trust = supervisor.good(self._config, self.trust, answered_s)

    def _lose(self, reason: Reason) -> None:
        """Obey nothing that was said before."""
        self._newest = None
        self.trust = supervisor.lost(self.trust, reason)

    def _publish(self, now_s: float) -> tuple[Sample, ...]:
        late = now_s - self._due_s > self._period_s
        self._due_s = (now_s if late else self._due_s) + self._period_s
        fresh_s = now_s - self._timeout_s - self._period_s
        self._published_s = {s: at for s, at in self._published_s.items() if at >= fresh_s}
        self._published_s[self.run.stamp_ns] = now_s
        return self.run.samples()

    def _command(self, now_s: float) -> BatteryPowerCommand:
        command, stamp_ns = self._newest, self.run.stamp_ns
        if not self.trust.nominal or command is None or not self._fresh(command.stamp_ns, now_s):
            reason = supervisor.command_reason(self.trust) or Reason.COMMAND_STALE
            self.fallback_ticks += 1
            self.fallback_reasons[reason] += 1
            return BatteryPowerCommand(stamp_ns, 0.0, mode=CommandMode.FALLBACK, reason=reason)
        then, _ = self._tick_of(command.stamp_ns)
        demand_w = self.run.power_demand_w
        return held_command(command, stamp_ns, float(demand_w[then]), float(demand_w[self.run.k]))

    def _within_ramp(self, command: BatteryPowerCommand) -> BatteryPowerCommand:
        limit = ramp_limit(self._generator_w, self._ramp_w_per_s, self.run.info.dt_s)
        if limit is None:
            return command
        wish = Command(np.array([command.battery_power_w]), np.array([command.engine_power_w]))
        lb, ub = self.run.feasible_w()
        k = self.run.k
        demand_w = self.run.power_demand_w[k : k + 1]
        made = lawful(wish, demand_w, np.array([lb]), np.array([ub]), limit)
        return replace(
            command,
            battery_power_w=float(made.battery_power_w[0]),
            engine_power_w=float(made.engine_power_w[0]),
        )

    def _tick_of(self, stamp_ns: int) -> tuple[int, int]:
        """The tick at or before a stamp of this run, and how long before [ns]."""
        return divmod(stamp_ns - self.run.info.t0_ns, self.run.info.dt_ns)

    def _published_at(self, stamp_ns: int) -> float:
        """When the plant was where the stamp says, by the wall clock; -inf: long ago [s]."""
        _, rest_ns = self._tick_of(stamp_ns)
        at_s = self._published_s.get(stamp_ns - rest_ns, -math.inf)
        return at_s + rest_ns / self.run.info.dt_ns * self._period_s

    def _fresh(self, stamp_ns: int, now_s: float) -> bool:
        return now_s - self._published_at(stamp_ns) <= self._timeout_s

    def _refusal(
        self, command: BatteryPowerCommand, command_publishers: int, now_s: float
    ) -> str | None:
        if not self.started or self.done:
            return "no_tick_in_flight"
        if command_publishers > 1:
            return "two_publishers"
        if command.mode is not CommandMode.NOMINAL:
            return f"{command.mode.name.lower()}_mode"
        ticks, rest_ns = self._tick_of(command.stamp_ns)
        if ticks < 0 or (rest_ns and (command.stamp_ns - self.run.info.t0_ns) % STAMP_GRID_NS):
            return "other_run"
        if ticks > self.run.k:
            return "future"
        if not math.isfinite(command.battery_power_w) or math.isinf(command.engine_power_w):
            return "not_finite"
        if abs(command.battery_power_w) > self._most_w:
            return "out_of_range"
        if not self._fresh(command.stamp_ns, now_s):
            return "stale"
        if command.stamp_ns < self._newest_ns:
            return "out_of_order"
        return None
