"""When to trust the other side: one condition machine for the policy (observations) and the
plant (commands). Pure functions over frozen dataclasses; no physics, no clock, no ROS.

Times are seconds of one steady clock. A good or bad event that is reported a rounding error
before the last one is harmless, and so is any flood: every count is bounded. A clock that jumps
back by more than the timeout, or is not finite, counts as silence.
"""

import math
from dataclasses import dataclass, replace
from enum import IntEnum

from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.types import Reason


class Condition(IntEnum):
    """What the machine thinks of the other side. The fallback law holds in all but NOMINAL; a
    policy that is still in INIT sends nothing."""

    INIT = 0
    NOMINAL = 1
    STALE = 2
    RECOVERING = 3
    FAULT = 4


CONDITION_TEXT = {
    Condition.INIT: "waiting for the first good one",
    Condition.NOMINAL: "driving",
    Condition.STALE: "fallback law",
    Condition.RECOVERING: "fallback law, counting good ones",
    Condition.FAULT: "fallback law, latched until a new run or until it is engaged again",
}
"""Each condition in words, for diagnostics."""

REASON_TEXT = {
    Reason.NONE: "nothing is wrong",
    Reason.NOT_STARTED: "nothing good has arrived yet",
    Reason.OBSERVATION_STALE: "observations stopped or are too old",
    Reason.OBSERVATION_IMPLAUSIBLE: "observations cannot be true",
    Reason.RECOVERING: "not enough good ones in a row yet",
    Reason.FAULT: "too many bad ones",
    Reason.POLICY_ERROR: "the policy failed or answered with what is no number",
    Reason.SHUTDOWN: "the policy is shutting down",
    Reason.HANDOVER: "the drive is being handed over, or two policies are connected",
    Reason.COMMAND_STALE: "commands stopped or are too old",
    Reason.OUTSIDE_ENVELOPE: "observations are outside what the policy was trained on",
}
"""Each reason in words, for diagnostics."""


@dataclass(frozen=True, slots=True)
class SupervisorConfig:
    """How patient the machine is.

    Attributes:
        timeout_s: silence after which NOMINAL and RECOVERING end, finite and > 0 [s].
        recover_after: good ones in a row, the first included, that end STALE, 1..1000.
        fault_after: bad ones in a row that latch FAULT, 0 (never)..1000. Each good one makes up
            for 1/recover_after of a bad one, so bad ones that are more than one in
            recover_after + 1 for long latch it too: such a source is as good as dead, though it
            is never silent for ``timeout_s``.
        good_every_s: good ones closer together than this count as one of ``recover_after``,
            so that a flood does not shorten the recovery; finite and >= 0 [s].
        stale_reason: what silence is called.

    Raises ConfigError where a value is out of range.
    """

    timeout_s: float
    recover_after: int = 3
    fault_after: int = 10
    good_every_s: float = 0.0
    stale_reason: Reason = Reason.OBSERVATION_STALE

    def __post_init__(self) -> None:
        if not (math.isfinite(self.timeout_s) and self.timeout_s > 0.0):
            raise ConfigError(f"timeout_s: {self.timeout_s}, allowed finite and > 0")
        if not 1 <= self.recover_after <= 1000:
            raise ConfigError(f"recover_after: {self.recover_after}, allowed 1..1000")
        if not 0 <= self.fault_after <= 1000:
            raise ConfigError(f"fault_after: {self.fault_after}, allowed 0..1000, 0 for never")
        if not (math.isfinite(self.good_every_s) and self.good_every_s >= 0.0):
            raise ConfigError(f"good_every_s: {self.good_every_s}, allowed finite and >= 0")


@dataclass(frozen=True, slots=True)
class SupervisorState:
    """Where the machine is.

    Attributes:
        condition: what holds now.
        reason: why it is not NOMINAL; what latched it in FAULT.
        good_s: when the newest good one was heard, -inf before the first [s].
        counted_s: when the newest one that counts for ``recover_after`` was heard [s].
        good_in_row: good ones since STALE, 0..recover_after; 0 in every other condition.
        charge: bad ones not yet made up for, in units of 1/recover_after.
        suspect: reason of the newest bad one since the last good one.
    """

    condition: Condition = Condition.INIT
    reason: Reason = Reason.NOT_STARTED
    good_s: float = -math.inf
    counted_s: float = -math.inf
    good_in_row: int = 0
    charge: int = 0
    suspect: Reason = Reason.NONE

    @property
    def nominal(self) -> bool:
        """True where the other side is trusted."""
        return self.condition is Condition.NOMINAL


def reset() -> SupervisorState:
    """The state before anything was heard: a new run, or a new engagement."""
    return SupervisorState()


def fault(state: SupervisorState, reason: Reason) -> SupervisorState:
    """FAULT for ``reason``, until :func:`reset`; the first reason is kept."""
    if state.condition is Condition.FAULT:
        return state
    return replace(state, condition=Condition.FAULT, reason=reason, good_in_row=0)


def lost(state: SupervisorState, reason: Reason) -> SupervisorState:
    """The other side itself says that it must not be trusted (shut down, fallback, doubled):
    STALE at once, without waiting for the timeout. INIT and FAULT stay."""
    if state.condition in (Condition.INIT, Condition.FAULT):
        return state
    return replace(state, condition=Condition.STALE, reason=reason, good_in_row=0)


def elapsed(config: SupervisorConfig, state: SupervisorState, now_s: float) -> SupervisorState:
    """Time has passed: nothing good for ``timeout_s`` ends NOMINAL and RECOVERING."""
    if state.condition not in (Condition.NOMINAL, Condition.RECOVERING):
        return state
    if abs(now_s - state.good_s) <= config.timeout_s:  # False for NaN: a broken clock is silence
        return state
    return lost(state, state.suspect or config.stale_reason)


def good(config: SupervisorConfig, state: SupervisorState, now_s: float) -> SupervisorState:
    """Something good was heard at ``now_s``: INIT -> NOMINAL, STALE -> RECOVERING -> NOMINAL."""
    state = elapsed(config, state, now_s)
    if state.condition is Condition.FAULT or not math.isfinite(now_s):
        return state
    back_s = state.good_s - now_s
    good_s = state.good_s if 0.0 < back_s <= config.timeout_s else now_s
    charge = max(state.charge - 1, 0)
    state = replace(state, good_s=good_s, charge=charge, suspect=Reason.NONE)
    if state.condition is Condition.INIT:
        return replace(state, condition=Condition.NOMINAL, reason=Reason.NONE)
    if state.condition is Condition.NOMINAL:
        return state
    first = state.condition is Condition.STALE
    if not first and abs(good_s - state.counted_s) < config.good_every_s:
        return state
    in_row = 1 if first else state.good_in_row + 1
    if in_row >= config.recover_after:
        return replace(state, condition=Condition.NOMINAL, reason=Reason.NONE, good_in_row=0)
    return replace(
        state,
        condition=Condition.RECOVERING,
        reason=Reason.RECOVERING,
        good_in_row=in_row,
        counted_s=good_s,
    )


def bad(
    config: SupervisorConfig, state: SupervisorState, now_s: float, reason: Reason
) -> SupervisorState:
    """Something was heard at ``now_s`` that must not be used.

    One bad one does not end NOMINAL, it just is no good one: without a good one NOMINAL ends at
    its timeout, for this ``reason``. RECOVERING falls back to STALE at once.
    """
    state = elapsed(config, state, now_s)
    if state.condition is Condition.FAULT:
        return state
    # Bounded, so that a machine that never latches does not owe for ever.
    most = max(config.fault_after, 1) * config.recover_after
    charge = min(state.charge + config.recover_after, most)
    state = replace(state, charge=charge, suspect=reason)
    if config.fault_after and charge >= most:
        return fault(state, reason)
    if state.condition in (Condition.STALE, Condition.RECOVERING):
        return lost(state, reason)
    return state


def command_reason(state: SupervisorState) -> Reason:
    """What a command says while this state holds: FAULT where it is latched, whatever latched
    it, else the state's own reason."""
    return Reason.FAULT if state.condition is Condition.FAULT else state.reason


def describe(state: SupervisorState) -> str:
    """The state in one line, for people."""
    text = f"{state.condition.name}: {CONDITION_TEXT[state.condition]}"
    return text if state.reason is Reason.NONE else f"{text} ({REASON_TEXT[state.reason]})"
