"""The samples on the wire as frozen dataclasses, units in their names.

One sample is one message. ``codec`` turns them into messages and back; nothing else does.
"""

import math
from dataclasses import dataclass
from enum import IntEnum

DEFAULT_T0_NS = 1_000_000_000_000
"""Stamp of the first simulated tick: 1000 s, because stamp 0 means "unset" elsewhere in ROS."""

MAX_STEPS = 10_000_000
"""Steps of the longest run: four months of seconds; readers build grids of this size. A run of
as many has no planned end."""


class CommandMode(IntEnum):
    """Why a command was sent. Only NOMINAL ever answers a lockstep tick."""

    NOMINAL = 0
    FALLBACK = 1
    SHUTDOWN = 2


class Reason(IntEnum):
    """Why a command is not the policy's own wish; travels with it when it is not NONE."""

    NONE = 0
    NOT_STARTED = 1
    OBSERVATION_STALE = 2
    OBSERVATION_IMPLAUSIBLE = 3
    RECOVERING = 4
    FAULT = 5
    POLICY_ERROR = 6
    SHUTDOWN = 7
    HANDOVER = 8
    COMMAND_STALE = 9
    OUTSIDE_ENVELOPE = 10


@dataclass(frozen=True, slots=True)
class PowerDemand:
    """Power demand at the DC bus at ``stamp_ns``, auxiliaries included; negative is valid [W]."""

    stamp_ns: int
    power_w: float


@dataclass(frozen=True, slots=True)
class BatteryReading:
    """Battery state at ``stamp_ns``. ``soc`` is a fraction 0..1 with float32 resolution (the
    message field is a float32); ``current_a`` is negative when discharging (REP 103)."""

    stamp_ns: int
    soc: float
    voltage_v: float
    current_a: float


@dataclass(frozen=True, slots=True)
class PowertrainReading:
    """State before decision k, and what was applied over [t_{k-1}, t_k).

    Attributes:
        stamp_ns: t_k.
        engine_on: engine state before decision k.
        time_in_state_s: how long it has been in that state [s].
        engine_power_w: engine power at t_k, the power held over the last step [W], 0 when off.
        charge_limit_w: largest power the battery can take now, as a magnitude >= 0 [W].
        discharge_limit_w: largest power the battery can give now, >= 0 [W].
        engine_limit_w: largest engine power possible in the coming step, at the bus, >= 0 [W].
        applied_battery_power_w: battery power over the last step, > 0 discharges [W].
        applied_engine_power_w: engine power over the last step [W].
        fuel_kg: fuel burnt over the last step, start fuel included [kg].
        shortfall_j: demand that was not met over the last step [J].
        dissipated_j: braking energy that had to be dissipated over the last step [J].
    """

    stamp_ns: int
    engine_on: bool
    time_in_state_s: float
    engine_power_w: float
    charge_limit_w: float
    discharge_limit_w: float
    engine_limit_w: float
    applied_battery_power_w: float
    applied_engine_power_w: float
    fuel_kg: float
    shortfall_j: float
    dissipated_j: float


@dataclass(frozen=True, slots=True)
class BatteryPowerCommand:
    """A policy's answer to the observation stamped ``stamp_ns``.

    ``battery_power_w`` > 0 discharges. ``engine_power_w`` is 0 to say "engine off" (it is never
    inferred from equality of two floats), NaN for no opinion. ``reason`` says why it is not the
    policy's own wish.
    """

    stamp_ns: int
    battery_power_w: float
    engine_power_w: float = float("nan")
    mode: CommandMode = CommandMode.NOMINAL
    reason: Reason = Reason.NONE


@dataclass(frozen=True, slots=True)
class RunInfo:
    """What a run is: sent once, latched, before the first tick.

    Attributes:
        run_id: unique per run; a new one resets every policy state, filter and history.
        cycle, cycle_hash: name and SHA-256 of the duty cycle.
        powertrain, powertrain_hash: name and SHA-256 of the powertrain parameters.
        t0_ns: stamp of tick 0, > 0.
        dt_s: step length [s], > 0.
        steps: number of decisions; the final state is stamped t0 + steps * dt.
        p_aux_w: auxiliary power contained in power_demand [W].
        soc_initial, soc_target: fractions 0..1.
        lockstep: True when the plant waits for the answer to each tick.
        expected_recorders: recorders that must be matched before the first answer.
        package_version: version of tractor_ems that made the run.
        command_line: what started the plant.
    """

    run_id: str
    cycle: str
    cycle_hash: str
    powertrain: str
    powertrain_hash: str
    t0_ns: int
    dt_s: float
    steps: int
    p_aux_w: float
    soc_initial: float
    soc_target: float
    lockstep: bool = True
    expected_recorders: int = 0
    package_version: str = ""
    command_line: str = ""

    @property
    def dt_ns(self) -> int:
        """Step length as an integer number of nanoseconds; stamps are built from it exactly."""
        return round(self.dt_s * 1e9)

    def stamp_ns(self, k: int) -> int:
        """Stamp of tick ``k`` [ns]."""
        return self.t0_ns + k * self.dt_ns

    def time_left_s(self, stamp_ns: int) -> float:
        """From a stamp to the planned end; infinite where the run has none (``MAX_STEPS``)."""
        if self.steps >= MAX_STEPS:
            return math.inf
        return max(self.stamp_ns(self.steps) - stamp_ns, 0) * 1e-9


@dataclass(frozen=True, slots=True)
class DutyCycleDemand:
    """Demand of the duty cycle at ``stamp_ns``, without the plant's auxiliaries; negative is
    valid [W]. A player publishes it for a plant that is told to drive it."""

    stamp_ns: int
    power_w: float


@dataclass(frozen=True, slots=True)
class DutyCycleInfo:
    """The duty cycle that a player is about to publish: sent once, latched, before any demand.

    Attributes:
        replay_id: unique per player.
        cycle, cycle_hash: name and SHA-256 of the duty cycle.
        t0_ns: stamp of step 0, > 0; the plant's tick 0 has it too.
        dt_s: step length [s], > 0.
        steps: number of steps.
        package_version: version of tractor_ems that plays.
        command_line: what started the player.
    """

    replay_id: str
    cycle: str
    cycle_hash: str
    t0_ns: int
    dt_s: float
    steps: int
    package_version: str = ""
    command_line: str = ""

    @property
    def dt_ns(self) -> int:
        """Step length as an integer number of nanoseconds; stamps are built from it exactly."""
        return round(self.dt_s * 1e9)

    def stamp_ns(self, k: int) -> int:
        """Stamp of step ``k`` [ns]."""
        return self.t0_ns + k * self.dt_ns


Sample = PowerDemand | BatteryReading | PowertrainReading | BatteryPowerCommand | RunInfo
"""What plant and policy say to each other."""

PlayerSample = DutyCycleDemand | DutyCycleInfo
"""What a player says to a plant that drives no cycle of its own."""
