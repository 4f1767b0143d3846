"""The last word before a command is published: projection, fallback law, generator ramp. Pure.

The plant checks again on its side; neither trusts the other. ``safe``, ``safe_command`` and
``fallback_command`` serve the simulator, whose published limits are complete; ``vehicle_command``
and ``vehicle_fallback`` serve a vehicle's, after :func:`within_powertrain`.
"""

import math
from dataclasses import replace

import numpy as np

from tractor_ems.policies.protocol import limits_of
from tractor_msgs_py.observation import Observation
from tractor_msgs_py.trajectory import FloatArray
from tractor_msgs_py.types import BatteryPowerCommand, CommandMode, Reason
from tractor_sim.powertrain import (
    Command,
    PlantState,
    PowertrainParams,
    feasible_battery_power_w,
    power_limits,
    project,
)
from tractor_sim.safe_command import RampLimit, bounds_w, fallback, generator_power_w, lawful

TOLERANCE_W = 1e-3
"""A command moved by less than this counts as untouched [W]."""


def safe(observation: Observation, command: Command) -> Command:
    """The commands of a batch, projected on the published limits.

    Battery power that is not finite becomes the fallback law's, engine power that is infinite
    becomes "no opinion".
    """
    lb, ub = feasible_battery_power_w(limits_of(observation), observation.power_demand_w)
    engine_w = command.engine_power_w
    return Command(
        project(command.battery_power_w, lb, ub), np.where(np.isinf(engine_w), np.nan, engine_w)
    )


def safe_command(observation: Observation, command: Command) -> tuple[BatteryPowerCommand, bool]:
    """The policy's command for a batch of one, made safe.

    Returns:
        The nominal command, and whether it had to be corrected.
    """
    made = safe(observation, command)
    battery_w, engine_w = float(made.battery_power_w[0]), float(made.engine_power_w[0])
    moved_w = abs(battery_w - float(command.battery_power_w[0]))
    corrected = math.isinf(command.engine_power_w[0]) or not moved_w <= TOLERANCE_W
    return BatteryPowerCommand(observation.stamp_ns, battery_w, engine_w), corrected


def fallback_command(observation: Observation, mode: CommandMode) -> BatteryPowerCommand:
    """The fallback law: zero battery power projected on the feasible set, clip(0, lb, ub)."""
    lb, ub = feasible_battery_power_w(limits_of(observation), observation.power_demand_w)
    zero_w = project(observation.power_demand_w[:1] * 0.0, lb[:1], ub[:1])
    return BatteryPowerCommand(observation.stamp_ns, float(zero_w[0]), mode=mode)


def within_powertrain(
    observation: Observation, params: PowertrainParams, dt_s: float | None = None
) -> Observation:
    """The observation with limits that this powertrain can keep, whatever was published.

    Each limit is the smaller of the published one, which is inf where no signal supplies it, and
    the powertrain's own at the observed state; always finite and >= 0. A limit that is NaN or
    negative counts as 0, an unknown SOC leaves the battery nothing, an unknown time in state or
    engine power does not limit the engine.

    Args:
        observation: of a vehicle, shape (B,).
        params: the powertrain that the policy was made for.
        dt_s: the period the limits must hold for [s]; None: the powertrain's step.
    """
    if dt_s is not None and dt_s != params.dt_s:
        params = replace(params, dt_s=dt_s)
    peak_w = params.engine.power_max_w
    known = (observation.soc >= 0.0) & (observation.soc <= 1.0)
    waited_s, power_w = observation.time_in_state_s, observation.engine_power_w
    state = PlantState(
        soc=np.where(known, observation.soc, params.battery.soc_min),
        engine_on=observation.engine_on,
        time_in_state_s=np.where(np.isfinite(waited_s), waited_s, math.inf),
        engine_power_w=np.clip(np.where(np.isfinite(power_w), power_w, peak_w), 0.0, peak_w),
    )
    own = power_limits(params, state)
    return replace(
        observation,
        charge_limit_w=_smaller_w(observation.charge_limit_w, np.where(known, own.charge_w, 0.0)),
        discharge_limit_w=_smaller_w(observation.discharge_limit_w, own.discharge_w),
        engine_limit_w=_smaller_w(observation.engine_limit_w, own.engine_w),
    )


def vehicle_command(
    observation: Observation, command: Command, ramp: RampLimit | None = None
) -> tuple[BatteryPowerCommand, bool]:
    """The policy's command for a batch of one, made safe for a vehicle.

    Unlike :func:`safe_command` it keeps to the battery's limits also where demand is beyond
    engine and battery, copes with any observation, and limits the generator's ramp.

    Returns:
        The nominal command, and whether it had to be corrected.
    """
    lb, ub = bounds_w(limits_of(observation), observation.power_demand_w)
    made = lawful(command, observation.power_demand_w, lb, ub, ramp)
    battery_w, engine_w = float(made.battery_power_w[0]), float(made.engine_power_w[0])
    moved_w = abs(battery_w - float(command.battery_power_w[0]))
    corrected = math.isinf(command.engine_power_w[0]) or not moved_w <= TOLERANCE_W
    return BatteryPowerCommand(observation.stamp_ns, battery_w, engine_w), corrected


def vehicle_fallback(
    observation: Observation,
    reason: Reason,
    mode: CommandMode = CommandMode.FALLBACK,
    ramp: RampLimit | None = None,
) -> BatteryPowerCommand:
    """The fallback law for a vehicle: zero battery power as near as limits and ramp let it."""
    lb, ub = bounds_w(limits_of(observation), observation.power_demand_w)
    made = fallback(observation.power_demand_w[:1], lb[:1], ub[:1], ramp)
    battery_w = float(made.battery_power_w[0])
    return BatteryPowerCommand(observation.stamp_ns, battery_w, mode=mode, reason=reason)


def generator_set_point_w(observation: Observation, command: BatteryPowerCommand) -> float:
    """P_gen that ``command`` leaves to the generator at this observation's demand, 0..its present
    limit [W]: what the next step's ramp starts from. NaN where the demand is not finite: nothing
    is known then, and the ramp starts from what was known before."""
    if not math.isfinite(observation.power_demand_w[0]):
        return math.nan
    wished_w = np.array([command.battery_power_w])
    set_point_w = generator_power_w(observation.power_demand_w[:1], wished_w)
    return float(np.fmin(set_point_w, observation.engine_limit_w[:1])[0])


def _smaller_w(published_w: FloatArray, own_w: FloatArray) -> FloatArray:
    return np.clip(np.where(np.isnan(published_w), 0.0, published_w), 0.0, own_w)
