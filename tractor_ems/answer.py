"""The policy's side of the protocol: join, decide once, answer, and know when to fall back.

A pure state machine around one :class:`Policy`: samples and a steady clock's seconds come in,
commands to publish come out. It neither subscribes nor publishes.
"""

from collections import Counter
from collections.abc import Callable
from typing import Any, TypeAlias

from tractor_ems.policies.protocol import Policy
from tractor_ems.safety import fallback_command, safe_command
from tractor_msgs_py.errors import PolicyError
from tractor_msgs_py.observation import Observation, ObservationBuilder
from tractor_msgs_py.types import (
    BatteryPowerCommand,
    BatteryReading,
    CommandMode,
    PowerDemand,
    PowertrainReading,
    RunInfo,
)

Observed: TypeAlias = PowerDemand | BatteryReading | PowertrainReading
"""A sample of what a policy observes."""


RunCheck: TypeAlias = Callable[[RunInfo], None]
"""Raises a TractorEmsError where a policy must not drive a run."""


class Answerer:
    """Answers each tick of a run exactly once, and a repeated tick from its cache.

    Attributes:
        run: the present run; None before the first run_info.
        refusals: samples and runs by what was wrong with them.
        corrected: commands of the policy that were not finite or not feasible.
        fallbacks: fallback commands given.
    """

    def __init__(
        self,
        policy: Policy,
        powertrain_hash: str | None = None,
        observation_timeout_s: float = 2.0,
        check_run: RunCheck | None = None,
    ) -> None:
        self.policy = policy
        self.corrected = 0
        self.fallbacks = 0
        self._powertrain_hash = powertrain_hash
        self._timeout_s = observation_timeout_s
        self._check_run = check_run
        self._builder = ObservationBuilder(policy.spec)
        self._memory: Any = None
        self._forget()

    def _forget(self) -> None:
        self._observation: Observation | None = None
        self._answer: BatteryPowerCommand | None = None
        self._connected = False
        self._over = False
        self._heard_s = 0.0

    @property
    def run(self) -> RunInfo | None:
        """The present run."""
        return self._builder.run

    @property
    def refusals(self) -> Counter[str]:
        """Samples that were not used, by reason."""
        return self._builder.refusals

    @property
    def counters(self) -> dict[str, int]:
        """What people want to see."""
        refused = {f"refused_{reason}": count for reason, count in sorted(self.refusals.items())}
        return {"corrected": self.corrected, "fallbacks": self.fallbacks, **refused}

    @property
    def active(self) -> bool:
        """True while a run that this policy has answered is not over."""
        return self._answer is not None and not self._over

    def start_run(self, run: RunInfo) -> None:
        """A run_info arrived; a new run id resets policy, filters and cache.

        Raises:
            PolicyError: the policy was made for another powertrain or another step length.
            TractorEmsError: whatever ``check_run`` found.
        """
        if self.run is not None and run.run_id == self.run.run_id:
            return
        if self._powertrain_hash is not None and run.powertrain_hash != self._powertrain_hash:
            raise PolicyError(
                f"policy {self.policy.name} was made for powertrain {self._powertrain_hash[:16]}, "
                f"the run has {run.powertrain} {run.powertrain_hash[:16]}; "
                "allow_other_powertrain would let it"
            )
        if self._check_run is not None:
            self._check_run(run)
        self._builder.start_run(run)
        self._memory = self.policy.init(1)
        self._forget()

    def observe(
        self,
        sample: Observed,
        command_subscribers: Callable[[], int],
        now_s: float,
    ) -> BatteryPowerCommand | None:
        """A sample arrived; the command to publish, if it is time for one.

        Before the first command of a run the plant and every recorder must be connected to the
        command topic: until then the answer stays in the cache and the plant repeats its tick.

        Raises whatever the policy raises, RunAborted where the run is not the promised one.
        """
        run = self.run
        if run is not None and sample.stamp_ns >= run.stamp_ns(run.steps):
            self._over = True  # the final state: nothing is left to decide
        if self._answer is not None and sample.stamp_ns == self._answer.stamp_ns:
            repeated = isinstance(sample, PowerDemand)  # one answer per resent tick
            return self._if_connected(command_subscribers) if repeated else None
        observation = self._builder.add(sample)
        if observation is None or run is None:
            return None
        self._observation, self._heard_s, self._over = observation, now_s, False
        command, self._memory = self.policy.act(observation, self._memory)
        self._answer, corrected = safe_command(observation, command)
        self.corrected += corrected
        return self._if_connected(command_subscribers)

    def overdue(self, now_s: float) -> BatteryPowerCommand | None:
        """The fallback command when a real-time run has gone silent, once per timeout.

        In lockstep there is none: a plant that waits must not be answered by a fallback.
        """
        run, observation = self.run, self._observation
        if run is None or run.lockstep or observation is None or self._over:
            return None
        if now_s - self._heard_s <= self._timeout_s:
            return None
        self._heard_s = now_s
        self.fallbacks += 1
        return fallback_command(observation, CommandMode.FALLBACK)

    def shutdown_command(self) -> BatteryPowerCommand | None:
        """The safe command to leave behind; None when no run is under way."""
        if self._observation is None or self._over:
            return None
        return fallback_command(self._observation, CommandMode.SHUTDOWN)

    def _if_connected(self, command_subscribers: Callable[[], int]) -> BatteryPowerCommand | None:
        run = self.run
        if not self._connected and run is not None:
            self._connected = command_subscribers() >= 1 + run.expected_recorders
        return self._answer if self._connected else None
