"""The policy's side of the protocol: join, decide once, answer, and know when to fall back.

A pure state machine around one :class:`Policy`: samples and a steady clock's seconds come in,
commands to publish come out. It neither subscribes nor publishes.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import TypeAlias

from tractor_ems.decide import NOT_KNOWN, Applied, DecideConfig, Decider, Decision
from tractor_ems.policies.protocol import Policy
from tractor_msgs_py.errors import PolicyError
from tractor_msgs_py.observation import ObservationBuilder
from tractor_msgs_py.types import (
    BatteryPowerCommand,
    BatteryReading,
    PowerDemand,
    PowertrainReading,
    RunInfo,
)

Observed: TypeAlias = PowerDemand | BatteryReading | PowertrainReading
"""A sample of what a policy observes."""


RunCheck: TypeAlias = Callable[[RunInfo], None]
"""Raises a TractorEmsError where a policy must not drive a run."""


def check_powertrain(policy: Policy, made_for: str | None, run: RunInfo) -> None:
    """Raise PolicyError where a run announces another powertrain than the policy was made for.

    Args:
        policy: for its name.
        made_for: SHA-256 of the powertrain; None: any will do.
        run: what was announced.
    """
    if made_for is not None and run.powertrain_hash != made_for:
        raise PolicyError(
            f"policy {policy.name} was made for powertrain {made_for[:16]}, "
            f"the run has {run.powertrain} {run.powertrain_hash[:16]}; "
            "allow_other_powertrain would let it"
        )


class Answerer:
    """Answers each tick of a run exactly once, and a repeated tick from its cache.

    Args:
        policy: who decides.
        powertrain_hash: the powertrain it was made for; None: any will do.
        observation_timeout_s: silence after which the fallback law holds in real time [s].
        check_run: raises where the policy must not drive a run.
        config: how it is watched and handed over; the timeout is the one above.
        soc_target: of every run; None: what the run says.

    Attributes:
        decider: trust, safety and hand-over.
        decision: what came of the newest observation that was used.
    """

    def __init__(
        self,
        policy: Policy,
        powertrain_hash: str | None = None,
        observation_timeout_s: float = 2.0,
        check_run: RunCheck | None = None,
        config: DecideConfig | None = None,
        soc_target: float | None = None,
    ) -> None:
        self.policy = policy
        config = replace(config or DecideConfig(), timeout_s=observation_timeout_s)
        self.decider = Decider(policy, config)
        self.soc_target = soc_target
        self._powertrain_hash = powertrain_hash
        self._check_run = check_run
        self._builder = ObservationBuilder(policy.spec)
        self._announced: RunInfo | None = None
        self._forget()

    def _forget(self) -> None:
        self.decision: Decision | None = None
        self._answer: BatteryPowerCommand | None = None
        self._reading: PowertrainReading | None = None
        self._connected = False
        self._over = False

    @property
    def run(self) -> RunInfo | None:
        """The present run; None before the first run_info."""
        return self._builder.run

    @property
    def refusals(self) -> Counter[str]:
        """Samples and runs that were not used, by reason."""
        return self._builder.refusals

    @property
    def corrected(self) -> int:
        """Commands of the policy that were not finite or not feasible."""
        return self.decider.corrected

    @property
    def fallbacks(self) -> int:
        """Fallback commands given."""
        return self.decider.fallbacks

    @property
    def counters(self) -> dict[str, int]:
        """What people want to see."""
        refused = {f"refused_{reason}": count for reason, count in sorted(self.refusals.items())}
        return {"corrected": self.corrected, "fallbacks": self.fallbacks, **refused}

    @property
    def active(self) -> bool:
        """True while a run that this policy has answered, or would have, is not over."""
        return self.decision is not None and not self._over

    def start_run(self, run: RunInfo) -> None:
        """A run_info arrived; a new run id resets policy, filters and cache.

        Raises:
            PolicyError: the policy was made for another powertrain or another step length.
            TractorEmsError: whatever ``check_run`` found.
        """
        if self.run is not None and run.run_id == self.run.run_id:
            return
        check_powertrain(self.policy, self._powertrain_hash, run)
        if self._check_run is not None:
            self._check_run(run)
        self._announced = run
        self._builder.start_run(self._aimed(run))
        self.decider.start(run.dt_s, supervised=not run.lockstep)
        self._forget()

    def aim(self, soc_target: float | None) -> None:
        """End at another SOC from the next tick on; None: where the run says."""
        self.soc_target = soc_target
        if self._announced is not None:
            self._builder.run = self._aimed(self._announced)

    def _aimed(self, run: RunInfo) -> RunInfo:
        return run if self.soc_target is None else replace(run, soc_target=self.soc_target)

    def observe(
        self,
        sample: Observed,
        command_subscribers: Callable[[], int],
        now_s: float,
    ) -> BatteryPowerCommand | None:
        """A sample arrived; the command to publish, if it is time for one.

        Before the first command of a run the plant and every recorder must be connected to the
        command topic: until then the answer stays in the cache and the plant repeats its tick.

        Raises whatever the policy raises in lockstep, RunAborted where the run is not the
        promised one.
        """
        run = self.run
        # Not any later stamp: one from the future must not look like the end and end the watch.
        if run is not None and sample.stamp_ns == run.stamp_ns(run.steps):
            self._over = True  # the final state: nothing is left to decide
            self.decider.clear()
        if self._answer is not None and sample.stamp_ns == self._answer.stamp_ns:
            repeated = isinstance(sample, PowerDemand)  # one answer per resent tick
            return self._if_connected(command_subscribers) if repeated else None
        if isinstance(sample, PowertrainReading):
            self._reading = sample
        observation = self._builder.add(sample)
        if observation is None or run is None:
            return None
        self._over, self._answer = False, None
        heard = self.decider.handover.commanding and command_subscribers() > 0
        applied = self._applied(observation.stamp_ns)
        decision = self.decider.decide(observation, now_s, heard=heard, applied=applied)
        if decision is None:
            return None
        self.decision, self._answer = decision, decision.command
        return self._if_connected(command_subscribers)

    def _applied(self, stamp_ns: int) -> Applied:
        reading = self._reading
        if reading is None or reading.stamp_ns != stamp_ns:
            return NOT_KNOWN
        return Applied(
            reading.applied_battery_power_w, reading.applied_engine_power_w, reading.fuel_kg
        )

    def overdue(self, now_s: float) -> BatteryPowerCommand | None:
        """The fallback command when a real-time run has gone silent: at once when its time is
        up, then once per timeout. In lockstep there is none."""
        return None if self._over else self.decider.overdue(now_s)

    def shutdown_command(self) -> BatteryPowerCommand | None:
        """The safe command to leave behind; None when no run is under way."""
        return None if self._over else self.decider.shutdown_command()

    def _if_connected(self, command_subscribers: Callable[[], int]) -> BatteryPowerCommand | None:
        run = self.run
        if self._answer is not None and not self._connected and run is not None:
            self._connected = command_subscribers() >= 1 + run.expected_recorders
        return self._answer if self._connected else None
