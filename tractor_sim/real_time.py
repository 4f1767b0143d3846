"""When the plant steps in real time: on a wall clock, with the newest command that is fresh.

Pure like its sibling ``lockstep``. Without a fresh command the fallback law holds: zero battery
power, projected on the feasible set. A dead or doubled policy never stops the plant.
"""

import math

from tractor_msgs_py.types import BatteryPowerCommand, CommandMode, Sample
from tractor_sim.pace import Pace
from tractor_sim.plant_run import PlantRun


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

    Attributes:
        fallback_ticks: steps driven by the fallback law.
    """

    def __init__(
        self,
        run: PlantRun,
        period_s: float,
        command_timeout_s: float,
        match_timeout_s: float = 0.0,
    ) -> None:
        super().__init__(run, match_timeout_s)
        self.fallback_ticks = 0
        self._period_s = period_s
        self._timeout_s = command_timeout_s
        self._due_s = 0.0
        self._published_s: dict[int, float] = {}
        self._newest: BatteryPowerCommand | None = None

    def _own_counters(self) -> dict[str, int]:
        return {"fallback_ticks": self.fallback_ticks}

    def _first_tick(self, now_s: float) -> tuple[Sample, ...]:
        self._due_s = now_s
        return self._publish(now_s)

    def poll(self, command_publishers: int, now_s: float) -> tuple[Sample, ...]:
        """Samples of the next tick when the present step's time is over, else nothing.

        A plant that was held up does not rush to catch up: time starts again from now.
        """
        if now_s < self._due_s:
            return ()
        if command_publishers > 1:
            self._newest = None
        self.run.apply(self._command(now_s))
        return self._publish(now_s)

    def offer(
        self, command: BatteryPowerCommand, command_publishers: int, now_s: float
    ) -> tuple[Sample, ...]:
        """A command arrived; it is kept or refused, and nothing is published."""
        reason = self._refusal(command, command_publishers, now_s)
        if reason is None:
            self._newest = command
        else:
            self.refusals[reason] += 1
            if command.mode is not CommandMode.NOMINAL or command_publishers > 1:
                self._newest = None
        return ()

    def _publish(self, now_s: float) -> tuple[Sample, ...]:
        late = now_s - self._due_s > self._period_s
        self._due_s = (now_s if late else self._due_s) + self._period_s
        fresh_s = now_s - self._timeout_s
        self._published_s = {s: at for s, at in self._published_s.items() if at >= fresh_s}
        self._published_s[self.run.stamp_ns] = now_s
        return self.run.samples()

    def _command(self, now_s: float) -> BatteryPowerCommand:
        command, stamp_ns, k = self._newest, self.run.stamp_ns, self.run.k
        if command is None or now_s - self._published_at(command) > self._timeout_s:
            self.fallback_ticks += 1
            return BatteryPowerCommand(stamp_ns, 0.0, mode=CommandMode.FALLBACK)
        then = (command.stamp_ns - self.run.info.t0_ns) // self.run.info.dt_ns
        demand_w = self.run.power_demand_w
        return held_command(command, stamp_ns, float(demand_w[then]), float(demand_w[k]))

    def _published_at(self, command: BatteryPowerCommand) -> float:
        return self._published_s.get(command.stamp_ns, -math.inf)

    def _refusal(
        self, command: BatteryPowerCommand, command_publishers: int, now_s: float
    ) -> str | None:
        if not self.started or self.done:
            return "no_tick_in_flight"
        if command_publishers > 1:
            return "two_publishers"
        if command.mode is not CommandMode.NOMINAL:
            return f"{command.mode.name.lower()}_mode"
        ticks, rest = divmod(command.stamp_ns - self.run.info.t0_ns, self.run.info.dt_ns)
        if rest or ticks < 0:
            return "other_run"
        if command.stamp_ns > self.run.stamp_ns:
            return "future"
        if not math.isfinite(command.battery_power_w) or math.isinf(command.engine_power_w):
            return "not_finite"
        if now_s - self._published_at(command) > self._timeout_s:
            return "stale"
        if self._newest is not None and command.stamp_ns < self._newest.stamp_ns:
            return "out_of_order"
        return None
