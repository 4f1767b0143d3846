"""The policy's side on a vehicle: signals at their own rates in, a decision at every tick out.

A pure state machine like its sibling ``answer``, around the same ``Decider``. Without a run_info
a run is made up once the signals have been heard for a while.
"""

import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace

from tractor_ems.answer import RunCheck, check_powertrain
from tractor_ems.decide import Applied, DecideConfig, Decider, Decision
from tractor_ems.policies.protocol import Policy
from tractor_ems.signals.vehicle import sampling_of, vehicle_run
from tractor_msgs_py.errors import PolicyError
from tractor_msgs_py.observation import (
    SAMPLED_SIGNALS,
    ObservationBuilder,
    ObservationSpec,
    SampledTick,
)
from tractor_msgs_py.sampling import LAG_S
from tractor_msgs_py.signals import ENGINE_ON_W, OBSERVED, SignalMap, Source
from tractor_msgs_py.types import BatteryPowerCommand, Reason, RunInfo

RUN_INFO_S = 1.0
"""How long a vehicle's signals are heard before a run is made up for want of a run_info [s]."""

END_S = 1.0
"""The first tick after a run comes this soon after one within it, or two ticks later [s]."""


def spec_on(
    signals: SignalMap, spec: ObservationSpec, dt_s: float, lag_s: float = LAG_S
) -> ObservationSpec:
    """What a policy needs to see on a vehicle.

    A policy for sampled signals keeps its own spec; what it does not see may be sampled otherwise
    than where it learnt. One for equal stamps keeps its filters and its step length, and is
    sampled as the map says.

    Args:
        signals: the vehicle's.
        spec: the policy's own.
        dt_s: period of a policy without one of its own [s].
        lag_s: how long its ticks wait for late samples, at most its period [s].

    Raises:
        PolicyError: the map asks for a sampling that the policy was not made for.
    """
    if spec.mode == "exact":
        dt_s, sampling = spec.dt_s or dt_s, sampling_of(signals)
        lag_s = min(lag_s, dt_s)
        return ObservationSpec(SAMPLED_SIGNALS, dt_s, spec.filters, "sampled", sampling, lag_s)
    own = {way.signal: way.how for way in spec.sampling}
    seen = OBSERVED if "engine_power_w" in signals.names else (*OBSERVED, "battery_power_w")
    for signal in signals.of(seen):
        how = own.get(signal.name)
        if None not in (signal.how, how) and signal.how != how:
            raise PolicyError(
                f"{signals.origin or signals.vehicle}: signals.{signal.name}.how: {signal.how}, "
                f"the policy was made for {how}"
            )
    return spec


@dataclass
class SampledCounters:
    """Ticks by what became of them.

    Attributes:
        ticks: that have come.
        blind: without an observation, after the run's first.
        skipped: decided late, together with a newer one, so their command was not published.
    """

    ticks: int = 0
    blind: int = 0
    skipped: int = 0


class SampledAnswerer:
    """Decides at every tick of a vehicle's clock.

    Args:
        policy: who decides.
        signals: where the signals come from.
        config: how it is watched and handed over, the policy's powertrain included.
        dt_s: period of a policy that has none of its own [s].
        powertrain_hash: the powertrain it was made for; None: any will do.
        check_run: raises where the policy must not drive a run.
        soc_target: of every run; None: what the run, the map, or the powertrain says.
        time_scale: seconds of stamps per second of the local clock.
        lag_s: how long a tick waits for late samples, for a policy that does not say [s].

    Attributes:
        spec: what the policy sees here.
        decider: trust, safety and hand-over.
        decision: what came of the newest observation that was used.
        missing: signals that the newest tick did without, with the reason.
        count: ticks by what became of them.

    Raises PolicyError where map and policy do not fit.
    """

    def __init__(
        self,
        policy: Policy,
        signals: SignalMap,
        config: DecideConfig,
        dt_s: float = 0.1,
        powertrain_hash: str | None = None,
        check_run: RunCheck | None = None,
        soc_target: float | None = None,
        time_scale: float = 1.0,
        lag_s: float = LAG_S,
    ) -> None:
        self.policy, self.signals = policy, signals
        self.spec = spec_on(signals, policy.spec, dt_s, lag_s)
        self.decider = Decider(policy, replace(config, vehicle=True))
        self.soc_target = soc_target
        self.count = SampledCounters()
        self._builder = ObservationBuilder(self.spec, signals)
        self._powertrain_hash, self._check_run = powertrain_hash, check_run
        self._time_scale = time_scale
        self._announced: RunInfo | None = None
        self._first_ns: int | None = None
        self._runs = 0
        self._forget()

    def _forget(self) -> None:
        self.decision: Decision | None = None
        self.missing: dict[str, str] = {}
        self._over = False
        self._heard_ns = self._used_ns = self._stamp_ns = 0

    @property
    def dt_s(self) -> float:
        """Period of the ticks [s]."""
        assert self.spec.dt_s is not None
        return self.spec.dt_s

    @property
    def run(self) -> RunInfo | None:
        """The present run; None before the first."""
        return self._builder.run

    @property
    def refusals(self) -> Counter[str]:
        """Samples that were not used, by reason."""
        return self._builder.refusals

    @property
    def complaints(self) -> dict[str, str]:
        """Signal to the last text about an implausible value."""
        return self._builder.complaints

    @property
    def counters(self) -> dict[str, int]:
        """What people want to see."""
        decider, count = self.decider, self.count
        counted = sorted(self.refusals.items())
        refused = {
            f"refused_{why}": n for why, n in counted if why not in ("late", "silent_ticks")
        }
        return {
            "ticks": count.ticks,
            "late_samples": self.refusals["late"],
            "missed_ticks": count.blind + count.skipped + self.refusals["silent_ticks"],
            "corrected": decider.corrected,
            "fallbacks": decider.fallbacks,
            **refused,
        }

    @property
    def active(self) -> bool:
        """True while a run that this policy has answered, or would have, is not over."""
        return self.decision is not None and not self._over

    def start_run(self, run: RunInfo) -> None:
        """A run_info arrived; a new run id resets policy, filters and samples.

        Raises:
            PolicyError: the policy was made for another powertrain, or the run is lockstep.
            TractorEmsError: whatever ``check_run`` found.
        """
        if self.run is not None and run.run_id == self.run.run_id:
            return
        if run.lockstep:
            raise PolicyError(
                "the run is lockstep: sampled signals need a plant in mode real_time"
            )
        check_powertrain(self.policy, self._powertrain_hash, run)
        if self._check_run is not None:
            self._check_run(run)
        self._start(run, run)

    def _start(self, run: RunInfo, announced: RunInfo | None) -> None:
        self._announced = announced
        soc_target = run.soc_target if self.soc_target is None else self.soc_target
        self._builder.start_run(replace(run, soc_target=soc_target), self._time_scale)
        self.decider.start(self.dt_s, supervised=True)
        self._forget()

    def _make_up(self, received_ns: int) -> None:
        """A run of our own, once nobody has announced one for long enough."""
        self._first_ns = self._first_ns or received_ns
        if received_ns - self._first_ns >= RUN_INFO_S * 1e9:
            self._runs += 1
            run_id = f"vehicle-{self._runs}"
            self._start(vehicle_run(self.dt_s, self._own_soc_target(), run_id), None)

    def _own_soc_target(self) -> float:
        params = self.decider.config.params
        if self.signals.soc_target is not None:
            return self.signals.soc_target
        if params is None:
            return 0.5
        return params.soc_initial if params.soc_target is None else params.soc_target

    def aim(self, soc_target: float | None) -> None:
        """End at another SOC from the next tick on; None: where run, map or powertrain say."""
        self.soc_target = soc_target
        run = self._builder.run
        if run is not None:
            said = run.soc_target if self._announced is None else self._announced.soc_target
            said = self._own_soc_target() if self._announced is None else said
            aimed = said if soc_target is None else soc_target
            self._builder.run = replace(run, soc_target=aimed)

    def sense(
        self,
        values: Iterable[tuple[Source, int, float]],
        received_ns: int,
        heard: bool = True,
    ) -> list[Decision]:
        """A message arrived: decisions of the ticks that have come by it, oldest first.

        Args:
            values: source, stamp [ns] and value of everything in it that is mapped.
            received_ns: when, by a steady clock.
            heard: somebody listens to the command topic.

        Never raises: what must not be used is refused and counted.
        """
        if self.run is None:
            self._make_up(received_ns)
        ticks: list[SampledTick] = []
        for source, stamp_ns, value in values:
            refused = self.refusals.total() - self.refusals["late"]
            ticks += self._builder.sense(source, stamp_ns, value, received_ns)
            if self.refusals.total() - self.refusals["late"] == refused:
                self._heard_ns = received_ns
        return self._decided(ticks, received_ns, heard)

    def poll(self, received_ns: int, heard: bool = True) -> list[Decision]:
        """Time has passed: decisions of the ticks that have come by it, oldest first."""
        return self._decided(self._builder.poll(received_ns), received_ns, heard)

    def wait_ns(self, received_ns: int) -> int | None:
        """How long until :meth:`poll` has the next tick; None before the first sample [ns]."""
        return self._builder.wait_ns(received_ns)

    def _decided(self, ticks: list[SampledTick], received_ns: int, heard: bool) -> list[Decision]:
        decisions = [self._decide(tick, received_ns, heard) for tick in ticks]
        made = [decision for decision in decisions if decision is not None]
        self.count.skipped += max(len(made) - 1, 0)
        return made

    def _decide(self, tick: SampledTick, received_ns: int, heard: bool) -> Decision | None:
        run, frame = self.run, tick.frame
        assert run is not None
        if self._announced is not None and frame.stamp_ns >= run.stamp_ns(run.steps):
            self._end(frame.stamp_ns)
            return None
        if frame.stamp_ns <= self._stamp_ns:
            self.decider.set_back()
        self._stamp_ns = frame.stamp_ns
        self.count.ticks += 1
        self.missing = dict(frame.missing)
        if tick.observation is None:
            self.count.blind += self.decision is not None
            self._blind(received_ns * 1e-9)
            return None
        fresh, self._used_ns = self._heard_ns > self._used_ns, self._heard_ns
        engine_w = float(tick.observation.engine_power_w[0])
        applied = Applied(
            frame.values.get("battery_power_w", math.nan),
            engine_w if engine_w > ENGINE_ON_W or tick.observation.engine_on[0] else 0.0,
            frame.values.get("fuel_kg_per_s", math.nan) * self.dt_s,
        )
        decision = self.decider.decide(
            tick.observation, self._heard_ns * 1e-9, heard=heard, fresh=fresh, applied=applied
        )
        if decision is not None:
            self.decision = decision
        return decision

    def _end(self, stamp_ns: int) -> None:
        """A tick after the announced run: it is over, unless the clock jumped there from within
        the run, which is a fault that must not end the watch."""
        reach_ns = max(2.0 * self.dt_s, END_S) * 1e9
        if self._over or stamp_ns - self._stamp_ns <= reach_ns:
            self._over = True
            self.decider.clear()
        else:
            self.count.blind += self.decision is not None
            self.decider.lost()

    def _blind(self, now_s: float) -> None:
        reasons = {why for name, why in self.missing.items() if name in OBSERVED}
        if "implausible" in reasons:
            self.decider.bad(now_s, Reason.OBSERVATION_IMPLAUSIBLE)
        elif "stale" in reasons:
            self.decider.lost()

    def overdue(self, now_s: float) -> BatteryPowerCommand | None:
        """The fallback command when the vehicle has gone silent: at once when its time is up,
        then once per timeout."""
        return None if self._over else self.decider.overdue(now_s)

    def shutdown_command(self) -> BatteryPowerCommand | None:
        """The safe command to leave behind; None where this policy does not drive."""
        return None if self._over else self.decider.shutdown_command()
