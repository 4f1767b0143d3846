"""What may be done with a wanted battery power: bounds, fallback law and the generator's ramp.

Physics only, pure numpy of shape (B,), shared by the plant and the policies. The laws, with the
generator's set-point P_gen = max(P_dem - P_batt, 0) and lb, ub of ``powertrain``:

    fallback:   P_batt = clip(0, lb, ub)
    ramp:       |P_gen,k - P_gen,k-1| <= r dt, as far as [lb, ub] lets it

Feasibility wins over the ramp: no result is outside [lb, ub]. What is not finite is replaced by
the fallback law: no result is anything but finite.
"""

import math
from dataclasses import dataclass

import numpy as np

from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.powertrain import Command, PowerLimits, feasible_battery_power_w, project

LIMIT_MAX_W = 1e12
"""A limit above this, such as the inf of a limit that nobody measures, counts as this [W]."""


@dataclass(frozen=True, slots=True)
class RampLimit:
    """How far the generator's set-point may go in one step.

    Attributes:
        generator_w: where it was, >= 0; not finite: unknown, so no limit holds [W].
        change_w: most change of this step, >= 0, inf for any [W].
    """

    generator_w: float
    change_w: float = math.inf


def ramp_limit(generator_w: float, ramp_w_per_s: float | None, dt_s: float) -> RampLimit | None:
    """The limit of one step of ``dt_s`` [s] from ``generator_w`` [W]; None where the ramp is
    None, 0 or inf, which all mean "no limit" [W/s].

    Raises:
        ConfigError: the ramp is negative or NaN.
    """
    if ramp_w_per_s is None or ramp_w_per_s == 0.0 or ramp_w_per_s == math.inf:
        return None
    if not ramp_w_per_s > 0.0:
        raise ConfigError(f"ramp_w_per_s: {ramp_w_per_s}, allowed >= 0, 0 for no limit")
    return RampLimit(generator_w, ramp_w_per_s * dt_s)


def bounds_w(limits: PowerLimits, power_demand_w: FloatArray) -> tuple[FloatArray, FloatArray]:
    """lb and ub that can always be kept: finite, lb <= ub, within the battery's own limits.

    As ``feasible_battery_power_w`` wherever that leaves a choice. Where it leaves none (demand
    beyond engine and battery, braking beyond the battery) both are the battery's nearest limit.
    A negative or unknown limit counts as 0, unknown demand as 0.
    """
    sound = PowerLimits(
        charge_w=_magnitude_w(limits.charge_w),
        discharge_w=_magnitude_w(limits.discharge_w),
        engine_w=_magnitude_w(limits.engine_w),
        engine_least_w=_magnitude_w(limits.engine_least_w),
        may_be_off=limits.may_be_off,
    )
    lb, ub = feasible_battery_power_w(sound, known_demand_w(power_demand_w))
    lb = np.clip(lb, -sound.charge_w, sound.discharge_w)
    return lb, np.maximum(lb, ub)


def known_demand_w(power_demand_w: FloatArray) -> FloatArray:
    """Demand, 0 where it is not finite [W]."""
    return np.where(np.isfinite(power_demand_w), power_demand_w, 0.0)


def generator_power_w(power_demand_w: FloatArray, battery_power_w: FloatArray) -> FloatArray:
    """The generator's set-point, P_gen = max(P_dem - P_batt, 0): it never takes power [W]."""
    return np.maximum(known_demand_w(power_demand_w) - battery_power_w, 0.0)


def lawful(
    command: Command,
    power_demand_w: FloatArray,
    lb: FloatArray,
    ub: FloatArray,
    ramp: RampLimit | None = None,
) -> Command:
    """``command`` within [lb, ub], finite, and no faster than ``ramp``.

    Args:
        command: the wish; an engine power of 0 asks for "engine off", which is P_gen = 0.
        power_demand_w: demand at the bus, shape (B,) [W].
        lb, ub: of :func:`bounds_w` [W].
        ramp: None for no limit.

    Returns:
        Battery power within [lb, ub]. The engine power wished for where it still holds, else
        NaN: also "engine off" has to wait until the ramp has brought P_gen down to 0.
    """
    demand_w, wish_w = known_demand_w(power_demand_w), command.engine_power_w
    if ramp is None:  # the same bits as ``project`` alone
        battery_w, slowed = command.battery_power_w, np.zeros(demand_w.shape, dtype=bool)
    else:
        asked_w = np.where(wish_w == 0.0, demand_w, command.battery_power_w)
        battery_w = project(asked_w, lb, ub)
        wanted_w = generator_power_w(demand_w, battery_w)
        known = math.isfinite(ramp.generator_w)
        before_w, change_w = (ramp.generator_w, ramp.change_w) if known else (0.0, math.inf)
        allowed_w = np.clip(wanted_w, before_w - change_w, before_w + change_w)
        slowed = allowed_w != wanted_w
        battery_w = np.where(slowed, demand_w - allowed_w, battery_w)
    battery_w = np.where(np.isfinite(power_demand_w), battery_w, 0.0)
    void = slowed | np.isinf(wish_w) | ~np.isfinite(power_demand_w)
    return Command(project(battery_w, lb, ub), np.where(void, np.nan, wish_w))


def fallback(
    power_demand_w: FloatArray, lb: FloatArray, ub: FloatArray, ramp: RampLimit | None = None
) -> Command:
    """The fallback law, zero battery power as near as [lb, ub] and ``ramp`` let it, shape (B,)."""
    nothing = np.zeros(lb.shape)
    return lawful(Command(nothing, np.full(lb.shape, np.nan)), power_demand_w, lb, ub, ramp)


def _magnitude_w(limit_w: FloatArray) -> FloatArray:
    return np.clip(np.where(np.isnan(limit_w), 0.0, limit_w), 0.0, LIMIT_MAX_W)
