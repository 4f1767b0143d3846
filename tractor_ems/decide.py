"""From one observation to one command: trust, policy, safety, hand-over. Pure, batch of one.

``answer`` (samples of equal stamp) and ``answer_sampled`` (a vehicle's signals) say when there is
an observation; what follows is the same for both and is in here.
"""

import math
from collections import Counter
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from tractor_ems import handover as ho
from tractor_ems import planned_end
from tractor_ems.envelope_watch import OUTSIDE_S, EnvelopeState, signals_of, watched
from tractor_ems.handover import HandoverConfig, HandoverState, Mode
from tractor_ems.plausible import Seen, judge, plausible_on
from tractor_ems.policies.envelope import Envelope
from tractor_ems.policies.protocol import Policy
from tractor_ems.safety import (
    fallback_command,
    safe_command,
    vehicle_command,
    vehicle_fallback,
    within_powertrain,
)
from tractor_msgs_py import supervisor
from tractor_msgs_py.errors import PolicyError
from tractor_msgs_py.observation import Observation
from tractor_msgs_py.supervisor import Condition, SupervisorConfig
from tractor_msgs_py.types import BatteryPowerCommand, CommandMode, Reason
from tractor_sim.powertrain import PowertrainParams

FAULT_S = 10.0
"""Observations that have been implausible for this long, in ticks, latch FAULT [s]."""


@dataclass(frozen=True, slots=True)
class DecideConfig:
    """How a policy is watched.

    Attributes:
        timeout_s: silence after which the fallback law holds, > 0 [s].
        handover: how fast it engages and disengages.
        shadow: begin in the shadow instead of engaged.
        params: the policy's powertrain; None: neither plausibility nor limits of its own.
        vehicle: published limits may be missing, so the powertrain's own hold too.
        envelope: what the policy saw in training; None: not known.
        outside_fallback: the fallback law holds while observations are away from that, for
            longer than ``outside_s``; not in lockstep.
        outside_s: how long outside that is, >= 0 [s].
    """

    timeout_s: float = 2.0
    handover: HandoverConfig = field(default_factory=HandoverConfig)
    shadow: bool = False
    params: PowertrainParams | None = None
    vehicle: bool = False
    envelope: Envelope | None = None
    outside_fallback: bool = False
    outside_s: float = OUTSIDE_S


@dataclass(frozen=True)
class Applied:
    """What was applied over the step that an observation ends; NaN where no signal says.

    Attributes:
        battery_power_w, engine_power_w: at the bus [W].
        fuel_kg: measured [kg].
    """

    battery_power_w: float = math.nan
    engine_power_w: float = math.nan
    fuel_kg: float = math.nan


NOT_KNOWN = Applied()


@dataclass(frozen=True)
class Decision:
    """What came of one observation.

    Attributes:
        observation: what was decided on.
        wish: the policy's own command made safe, or the fallback law.
        command: what to publish; None: nothing.
        applied: over the step before, by whomever.
    """

    observation: Observation
    wish: BatteryPowerCommand
    command: BatteryPowerCommand | None
    applied: Applied = NOT_KNOWN


class Decider:
    """One policy, its memory, whether its observations are trusted, and whether it drives.

    Attributes:
        config: how it is watched; may be replaced at any time.
        trust: the supervisor's state; a lockstep run is not supervised.
        handover: where the hand-over is.
        corrected, fallbacks: commands of the policy that were not finite or not feasible;
            fallback commands given.
        complaint: the last text about an implausible observation.
        trouble: what the policy raised, empty where it did not.
        reasons: bad observations and answers by reason, of all runs.
        plan: the end of the work as the operator plans it.
        envelope: whether observations are outside what the policy was trained on.
        outside_ticks: observations outside by signal, of all runs.
    """

    def __init__(self, policy: Policy, config: DecideConfig) -> None:
        self.policy, self.config = policy, config
        self.corrected = self.fallbacks = 0
        self.reasons: Counter[str] = Counter()
        self.outside_ticks: Counter[str] = Counter()
        self.plan = planned_end.PlannedEnd()
        self.handover = HandoverState(Mode.SHADOW if config.shadow else Mode.ENGAGED)
        self._plausible = None if config.params is None else plausible_on(config.params)
        self.start(1.0, supervised=False)

    def start(self, dt_s: float, *, supervised: bool) -> None:
        """A new run: forget all but who drives.

        Args:
            dt_s: time between ticks [s].
            supervised: False in lockstep, where the plant waits for every answer and what the
                policy raises ends the run.
        """
        self._dt_s, self._supervised = dt_s, supervised
        self._memory: Any = self.policy.init(1)
        self._seen = Seen()
        self._observation: Observation | None = None
        self._said_s, self._said_in = -np.inf, Condition.INIT
        self.envelope = EnvelopeState()
        self.plan_work(self.plan.work_s)
        self.handover = replace(self.handover, generator_w=np.nan)
        self.clear()

    def rehearse(self, dt_s: float = 1.0) -> None:
        """Decide once on a made-up observation and forget it, so that the first tick does not
        wait for what is loaded on first use (measured: 20-30 ms). A policy that decides on its
        own run alone may refuse; that is no fault."""
        half, power_w = np.array([0.5]), np.array([50e3])
        made_up = Observation(
            stamp_ns=1,
            power_demand_w=power_w,
            soc=half,
            soc_target=half,
            engine_on=np.array([False]),
            time_in_state_s=np.array([60.0]),
            engine_power_w=np.zeros(1),
            charge_limit_w=power_w,
            discharge_limit_w=power_w,
            engine_limit_w=power_w,
            features=np.zeros((1, len(self.policy.spec.filters))),
        )
        before = self.handover, self.corrected, self.fallbacks, self.reasons.copy()
        self.start(dt_s, supervised=True)
        self.decide(made_up, 0.0)
        self.handover, self.corrected, self.fallbacks, self.reasons = before
        self.outside_ticks.clear()
        self.start(dt_s, supervised=False)

    def clear(self) -> None:
        """Trust anew, also after FAULT."""
        self.trust = supervisor.reset()
        self.complaint = self.trouble = ""

    def set_back(self) -> None:
        """The vehicle's clock was set back: nothing that was remembered is of this time, and
        trust must be earned again. FAULT stays, and so does who drives."""
        self._memory, self._seen = self.policy.init(1), Seen()
        self.plan = planned_end.paused(self.plan)
        self.trust = supervisor.lost(self.trust, Reason.OBSERVATION_STALE)

    def plan_work(self, work_s: float) -> None:
        """The work ends this long after the next observation; 0: when the run says [s]."""
        self.plan = planned_end.planned(work_s)

    @property
    def away(self) -> bool:
        """True where the fallback law holds because the policy knows nothing like this."""
        return self.config.outside_fallback and self._supervised and self.envelope.away

    @property
    def mode(self) -> Mode:
        """Where the hand-over is."""
        return self.handover.mode

    @property
    def observation(self) -> Observation | None:
        """The newest one of this run that was plausible."""
        return self._observation

    def _watch(self) -> SupervisorConfig:
        ticks = round(np.clip(FAULT_S / self._dt_s, 10, 1000))
        return SupervisorConfig(
            self.config.timeout_s, fault_after=ticks, good_every_s=0.5 * self._dt_s
        )

    def decide(
        self,
        observation: Observation,
        now_s: float,
        *,
        heard: bool = True,
        fresh: bool = True,
        applied: Applied = NOT_KNOWN,
    ) -> Decision | None:
        """The next observation; None where it must not be used.

        Args:
            observation: of the run, stamps ascending.
            now_s: when its newest sample was heard, by a steady clock [s].
            heard: somebody listens to the command topic.
            fresh: something was heard since the last tick; else it is no proof of life.
            applied: over the step that the observation ends.

        Raises whatever the policy raises in a lockstep run.
        """
        if not self._supervised:
            return self._unsupervised(observation, applied)
        if not self._believe(observation, now_s, fresh):
            return None
        params, command, corrected = self.config.params, None, False
        if self.config.vehicle and params is not None:
            observation = within_powertrain(observation, params, self._dt_s)
        observation = self._noted(observation)
        try:
            command, self._memory = self.policy.act(observation, self._memory)
        except Exception as error:  # any: a driver that fails must be replaced, not mourned
            self.trouble = f"{type(error).__name__}: {error}"
            self.reasons[Reason.POLICY_ERROR.name.lower()] += 1
            self.trust = supervisor.fault(self.trust, Reason.POLICY_ERROR)
        if command is not None and not np.isfinite(command.battery_power_w).all():
            self.bad(now_s, Reason.POLICY_ERROR)
        if command is None or not self.trust.nominal:
            self.fallbacks += self.handover.commanding
            wish = vehicle_fallback(observation, self._reason())
        elif self.away:
            self.fallbacks += self.handover.commanding
            wish = vehicle_fallback(observation, Reason.OUTSIDE_ENVELOPE)
        else:
            made = vehicle_command if self.config.vehicle else safe_command
            wish, corrected = made(observation, command)
            if not np.isfinite(command.battery_power_w).all():
                wish = replace(wish, reason=Reason.POLICY_ERROR)  # the fallback law instead of it
        self.corrected += corrected
        self.handover, sent = ho.hand_over(
            self.config.handover, self.handover, observation, wish, self._dt_s, heard
        )
        if sent is not None:
            self._said(now_s)
            if self.mode is Mode.SHADOW:
                self.clear()
        return Decision(observation, wish, sent, applied)

    def _noted(self, observation: Observation) -> Observation:
        """An observation that is decided on: with the planned end, and watched."""
        self.plan, observation = planned_end.counted(self.plan, observation)
        if self.config.envelope is not None:
            self.envelope = watched(
                self.config.envelope, self.config.outside_s, self.envelope, observation, self._dt_s
            )
            self.outside_ticks.update(signals_of(self.envelope.outside))
        self._observation = observation
        return observation

    def _said(self, now_s: float) -> None:
        self._said_s, self._said_in = now_s, self.trust.condition

    def _unsupervised(self, observation: Observation, applied: Applied) -> Decision:
        observation = self._noted(observation)
        command, self._memory = self.policy.act(observation, self._memory)
        wish, corrected = safe_command(observation, command)
        self.corrected += corrected
        return Decision(observation, wish, wish if self.handover.commanding else None, applied)

    def _believe(self, observation: Observation, now_s: float, fresh: bool) -> bool:
        if self._plausible is not None:
            self._seen, wrong = judge(self._plausible, self._seen, observation)
            if wrong is not None:
                self.complaint = wrong.text
                self.bad(now_s, wrong.reason)
                return False
        if fresh:
            self.trust = supervisor.good(self._watch(), self.trust, now_s)
        return fresh or self.trust.nominal

    def bad(self, now_s: float, reason: Reason) -> None:
        """A tick without an observation that can be used."""
        self.reasons[reason.name.lower()] += 1
        self.trust = supervisor.bad(self._watch(), self.trust, now_s, reason)

    def lost(self) -> None:
        """A signal has stopped: older than its own largest age."""
        self.trust = supervisor.lost(self.trust, Reason.OBSERVATION_STALE)

    def overdue(self, now_s: float) -> BatteryPowerCommand | None:
        """The fallback law from the last observation: when trust is lost, and once per timeout
        while no tick says it. In lockstep there is none: a plant that waits must not be answered
        by a fallback."""
        if not self._supervised:
            return None
        self.trust = supervisor.elapsed(self._watch(), self.trust, now_s)
        silent = self.trust.condition in (Condition.STALE, Condition.FAULT)
        if not silent or self._observation is None or not self.handover.commanding:
            return None
        new = self._said_in not in (self.trust.condition, Condition.RECOVERING)
        if not new and now_s - self._said_s <= self.config.timeout_s:
            return None
        self._said(now_s)
        self.fallbacks += 1
        if self.mode is Mode.DISENGAGING:
            self.handover = HandoverState()
            self.clear()
            return ho.ended(self._observation)
        said = vehicle_fallback(self._observation, self._reason())
        self.handover = replace(self.handover, generator_w=ho.set_point_w(self._observation, said))
        return said

    def engage(self) -> str:
        """Begin to drive; what happens, in words. Raises PolicyError where it must not."""
        if self._observation is not None and not self._supervised:
            raise PolicyError("not in lockstep: the plant waits for every answer of one policy")
        if self._observation is None or not self.trust.nominal:
            detail = self.trouble or self.complaint
            if not detail and self._observation is None:
                detail = "no observation of a run that can be used yet, see /diagnostics"
            said = supervisor.describe(self.trust)
            raise PolicyError(f"{said}; {detail}" if detail else said)
        if self.mode in (Mode.ENGAGING, Mode.ENGAGED):
            return f"already {self.mode.name.lower()}"
        if self.away:
            raise PolicyError(f"outside what the policy was trained on: {self.envelope.text}")
        if self.mode is Mode.SHADOW:
            self.plan_work(self.plan.work_s)
        self.handover = ho.engage(self.handover)
        now_w = float(self._observation.engine_power_w[0])
        return f"engaging from {now_w:.0f} W, at most {self._ramp_text()}"

    def disengage(self) -> tuple[BatteryPowerCommand | None, str]:
        """Stop driving: the last command, where it stops at once, and what happens, in words.

        A fault is forgotten. Raises PolicyError in a lockstep run.
        """
        if not self._supervised and self._observation is not None:
            raise PolicyError("not in lockstep: the plant waits for every answer")
        if not self.handover.commanding:
            self.clear()
            return None, "already in the shadow"
        observation, ticking = self._observation, self.trust.nominal
        self.handover = ho.disengage(self.handover)
        if ticking and self.handover.commanding:
            return None, f"disengaging, at most {self._ramp_text()}; once more stops at once"
        self.handover = HandoverState()
        self.clear()
        return None if observation is None else ho.ended(observation), "stopped at once"

    def _ramp_text(self) -> str:
        ramp_w_per_s = self.config.handover.ramp_w_per_s
        return f"{ramp_w_per_s:g} W/s" if ramp_w_per_s else "any W/s"

    def shutdown_command(self) -> BatteryPowerCommand | None:
        """The safe command to leave behind; None where this policy does not drive."""
        if self._observation is None or not self.handover.commanding:
            return None
        if self.config.vehicle:
            return vehicle_fallback(self._observation, Reason.SHUTDOWN, CommandMode.SHUTDOWN)
        left = fallback_command(self._observation, CommandMode.SHUTDOWN)
        return replace(left, reason=Reason.SHUTDOWN)

    def _reason(self) -> Reason:
        return supervisor.command_reason(self.trust)
