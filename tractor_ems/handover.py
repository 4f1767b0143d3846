"""Who drives: a policy in the shadow of another, on its way in, driving, or on its way out. Pure.

On the way in the generator begins where it is and moves to the policy's wish, on the way out it
moves from there to the fallback law, both by at most ``ramp_w_per_s``; the feasible set wins over
the ramp. Nothing in here publishes.
"""

import math
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np

from tractor_ems.safety import generator_set_point_w, vehicle_command, vehicle_fallback
from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.observation import Observation
from tractor_msgs_py.types import BatteryPowerCommand, CommandMode, Reason
from tractor_sim.powertrain import Command
from tractor_sim.safe_command import RampLimit, ramp_limit

DEFAULT_RAMP_W_PER_S = 60e3
"""Ramp of a hand-over where the powertrain has none: idle to rated power in a few seconds."""

HOLD_TICKS = 3
"""Ticks for which a new publisher holds what is applied, until everybody hears it."""

MOST_WAITS = 3
"""Ticks for which the ramp stands while the generator has not followed its last step: a command
that came too late to be applied must not make the next step twice as large. A generator that
never shows what it does is moved all the same, at a quarter of the ramp."""

REACHED_W = 1.0
"""A generator set-point this close is reached [W]."""


class Mode(IntEnum):
    """Where the hand-over is."""

    SHADOW = 0
    ENGAGING = 1
    ENGAGED = 2
    DISENGAGING = 3


@dataclass(frozen=True, slots=True)
class HandoverConfig:
    """How fast.

    Attributes:
        ramp_w_per_s: most change of the generator's set-point, >= 0, 0 or inf for any [W/s].
        always: also while engaged.

    Raises ConfigError where the ramp is negative or NaN.
    """

    ramp_w_per_s: float = DEFAULT_RAMP_W_PER_S
    always: bool = False

    def __post_init__(self) -> None:
        if not self.ramp_w_per_s >= 0.0:
            raise ConfigError(f"ramp_w_per_s: {self.ramp_w_per_s}, allowed >= 0, 0 for no limit")


@dataclass(frozen=True, slots=True)
class HandoverState:
    """Where it is, and where the generator's set-point was.

    Attributes:
        mode: where it is.
        generator_w: set-point of the last command, NaN: what is observed counts [W].
        held: ticks for which what is applied was held, 0..:data:`HOLD_TICKS`.
        step_w: the last change of that set-point along the ramp, 0 before the first [W].
        observed_w: the generator as it was observed when that change was commanded [W].
        waits: ticks for which it has not followed, 0..:data:`MOST_WAITS`.
    """

    mode: Mode = Mode.SHADOW
    generator_w: float = math.nan
    held: int = 0
    step_w: float = 0.0
    observed_w: float = math.nan
    waits: int = 0

    @property
    def commanding(self) -> bool:
        """True where commands are published."""
        return self.mode is not Mode.SHADOW


def ramp_of(engine_ramp_w_per_s: float) -> float:
    """The ramp of a hand-over: the powertrain's where it is finite, else the default [W/s]."""
    return engine_ramp_w_per_s if math.isfinite(engine_ramp_w_per_s) else DEFAULT_RAMP_W_PER_S


def engage(state: HandoverState) -> HandoverState:
    """The policy shall drive. From the shadow it begins at what is observed."""
    if state.mode is Mode.SHADOW:
        return HandoverState(Mode.ENGAGING)
    return replace(state, mode=Mode.ENGAGING) if state.mode is Mode.DISENGAGING else state


def disengage(state: HandoverState) -> HandoverState:
    """The policy shall no longer drive. Asked again on its way out, it stops at once."""
    if state.mode in (Mode.SHADOW, Mode.DISENGAGING):
        return HandoverState()
    return replace(state, mode=Mode.DISENGAGING)


def ended(observation: Observation) -> BatteryPowerCommand:
    """The last command of a drive that ends: the fallback law."""
    return vehicle_fallback(observation, Reason.HANDOVER)


def set_point_w(observation: Observation, command: BatteryPowerCommand) -> float:
    """The generator power that a command asks for at this observation's demand, >= 0 [W]."""
    off = command.engine_power_w == 0.0
    return 0.0 if off else generator_set_point_w(observation, command)


def limit_of(
    config: HandoverConfig, state: HandoverState, observation: Observation, dt_s: float
) -> RampLimit | None:
    """The ramp that holds for the next command; None where none does."""
    if state.mode is Mode.SHADOW or (state.mode is Mode.ENGAGED and not config.always):
        return None
    known = math.isfinite(state.generator_w)
    before_w = state.generator_w if known else float(observation.engine_power_w[0])
    limit = ramp_limit(before_w, config.ramp_w_per_s, dt_s)
    return (
        RampLimit(before_w, 0.0) if limit is not None and _awaited(state, observation) else limit
    )


def _awaited(state: HandoverState, observation: Observation) -> bool:
    """Less than half of the last step along the ramp is seen, and there is patience left."""
    if state.mode is Mode.ENGAGED or abs(state.step_w) <= REACHED_W or state.waits >= MOST_WAITS:
        return False
    seen_w = float(observation.engine_power_w[0]) - state.observed_w
    return seen_w / state.step_w < 0.5


def _after(
    state: HandoverState, mode: Mode, observation: Observation, generator_w: float
) -> HandoverState:
    """The state after a command on the way that asked for ``generator_w``."""
    if _awaited(state, observation):
        return replace(state, mode=mode, generator_w=generator_w, waits=state.waits + 1)
    observed_w = float(observation.engine_power_w[0])
    before_w = state.generator_w if math.isfinite(state.generator_w) else observed_w
    return HandoverState(mode, generator_w, state.held, generator_w - before_w, observed_w)


def hand_over(
    config: HandoverConfig,
    state: HandoverState,
    observation: Observation,
    wish: BatteryPowerCommand,
    dt_s: float,
    heard: bool = True,
) -> tuple[HandoverState, BatteryPowerCommand | None]:
    """One tick.

    Args:
        config: how fast.
        state: of the last tick.
        observation: of batch one, its limits finite.
        wish: what shall be commanded: the policy's own command made safe, or the fallback law.
        dt_s: time since the last tick, > 0 [s].
        heard: somebody listens to the command topic; until then what is applied is held.

    Returns:
        The next state and the command to publish, None in the shadow. A command that ends the
        drive has mode FALLBACK, and the state that comes with it is the shadow's.
    """
    if state.mode is Mode.SHADOW:
        return state, None
    limit = limit_of(config, state, observation, dt_s)
    if state.mode is Mode.DISENGAGING:
        return _way_out(state, observation, limit)
    if state.mode is Mode.ENGAGING and (not heard or state.held < HOLD_TICKS):
        held = state.held + 1 if heard else 0
        applied_w = observation.power_demand_w[0] - max(float(observation.engine_power_w[0]), 0.0)
        made = _ramped(observation, applied_w, wish, limit)
        return HandoverState(Mode.ENGAGING, held=held), replace(made, reason=Reason.HANDOVER)
    made = wish if limit is None else _ramped(observation, wish.battery_power_w, wish, limit)
    generator_w = set_point_w(observation, made)
    reached = abs(generator_w - set_point_w(observation, wish)) <= REACHED_W
    if state.mode is Mode.ENGAGING and not reached:
        if made.mode is CommandMode.NOMINAL:
            made = replace(made, reason=Reason.HANDOVER)
        return _after(state, Mode.ENGAGING, observation, generator_w), made
    return HandoverState(Mode.ENGAGED, generator_w, state.held), made


def _way_out(
    state: HandoverState, observation: Observation, limit: RampLimit | None
) -> tuple[HandoverState, BatteryPowerCommand]:
    last = ended(observation)
    made = vehicle_fallback(observation, Reason.HANDOVER, CommandMode.NOMINAL, limit)
    generator_w = set_point_w(observation, made)
    if abs(generator_w - set_point_w(observation, last)) <= REACHED_W:
        return HandoverState(), last
    return _after(state, Mode.DISENGAGING, observation, generator_w), made


def _ramped(
    observation: Observation,
    battery_power_w: float,
    wish: BatteryPowerCommand,
    limit: RampLimit | None,
) -> BatteryPowerCommand:
    """``battery_power_w`` with the ramp's limit, otherwise as the wish: its mode and reason, and
    its engine power where it asks for the same."""
    same = battery_power_w == wish.battery_power_w
    engine_w = wish.engine_power_w if same else math.nan
    asked = Command(np.array([battery_power_w]), np.array([engine_w]))
    made, _ = vehicle_command(observation, asked, limit)
    return replace(made, mode=wish.mode, reason=wish.reason)
