"""Engine: fuel against power, and the start and ramp logic around it.

Either the efficiency or the fuel rate is piecewise linear over power at the crankshaft; off burns
nothing.
"""

from dataclasses import dataclass

import numpy as np

from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.trajectory import BoolArray, FloatArray


@dataclass(frozen=True)
class EngineParams:
    """Engine curve and start-stop behaviour.

    Attributes:
        power_max_w: largest crankshaft power [W].
        curve_power_w: knots of the curve, increasing from 0 to power_max_w [W].
        curve_efficiency: efficiency at the knots, 0 < value < 1; empty with a fuel curve.
        fuel_lhv_j_per_kg: lower heating value [J/kg].
        idle_fuel_kg_per_s: least fuel rate while on [kg/s].
        start_fuel_kg: fuel of one start [kg].
        min_on_s, min_off_s: least time in a state before it may be left [s].
        ramp_w_per_s: largest change of power while on, inf for none [W/s].
        curve_fuel_kg_per_s: fuel rate while on at the knots, increasing; its first value, at
            power 0, is what the engine burns idling [kg/s]. Empty with an efficiency curve.
    """

    power_max_w: float
    curve_power_w: tuple[float, ...]
    curve_efficiency: tuple[float, ...]
    fuel_lhv_j_per_kg: float
    idle_fuel_kg_per_s: float = 0.0
    start_fuel_kg: float = 0.0
    min_on_s: float = 0.0
    min_off_s: float = 0.0
    ramp_w_per_s: float = float("inf")
    curve_fuel_kg_per_s: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        for name in ("power_max_w", "fuel_lhv_j_per_kg"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ConfigError(f"engine.{name}: {value}, allowed finite and > 0")
        for name in ("idle_fuel_kg_per_s", "start_fuel_kg", "min_on_s", "min_off_s"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise ConfigError(f"engine.{name}: {value}, allowed finite and >= 0")
        if not self.ramp_w_per_s > 0:
            raise ConfigError(f"engine.ramp_w_per_s: {self.ramp_w_per_s}, allowed > 0")
        self._check_curve()

    def _check_curve(self) -> None:
        power, fuel = np.array(self.curve_power_w), np.array(self.curve_fuel_kg_per_s)
        eta = np.array(self.curve_efficiency)
        name, values = ("fuel rates", fuel) if len(fuel) else ("efficiencies", eta)
        if len(fuel) and len(eta):
            raise ConfigError("engine.curve_efficiency, curve_fuel_kg_per_s: only one is allowed")
        if len(power) < 2 or len(power) != len(values):
            raise ConfigError(
                f"engine.curve_power_w: {len(power)} powers, {len(values)} {name}, "
                "at least 2 of each in equal number"
            )
        if power[0] != 0.0 or not np.all(np.diff(power) > 0):
            raise ConfigError("engine.curve_power_w: must start at 0 and increase")
        if power[-1] != self.power_max_w:
            raise ConfigError(
                f"engine.curve_power_w: ends at {power[-1]} W, power_max_w is {self.power_max_w}"
            )
        if not len(fuel):
            if not np.all((eta > 0) & (eta < 1)):
                raise ConfigError("engine.curve_efficiency: every value must lie in 0 < value < 1")
            return
        least = power / self.fuel_lhv_j_per_kg
        if not (np.all(np.diff(fuel) > 0) and fuel[0] >= 0 and np.all(fuel[1:] > least[1:])):
            raise ConfigError(
                "engine.curve_fuel_kg_per_s: must increase from >= 0 and be more than "
                "power / fuel_lhv_j_per_kg (an efficiency below 1)"
            )


def efficiency(params: EngineParams, power_w: FloatArray) -> FloatArray:
    """Crankshaft efficiency at ``power_w`` (any shape) while on, clamped to the curve's ends."""
    if not params.curve_fuel_kg_per_s:
        return np.interp(power_w, params.curve_power_w, params.curve_efficiency)
    power = np.clip(power_w, 0.0, params.power_max_w)
    burning = np.interp(power, params.curve_power_w, params.curve_fuel_kg_per_s)
    eta: FloatArray = power / np.where(power > 0.0, burning * params.fuel_lhv_j_per_kg, 1.0)
    return eta


def fuel_rate_kg_per_s(
    params: EngineParams, power_w: FloatArray, engine_on: BoolArray | None = None
) -> FloatArray:
    """Fuel rate [kg/s]: the fuel curve or P / (eta(P) * LHV), at least the idle rate; an engine
    that is off burns nothing. ``engine_on`` defaults to ``power_w > 0`` (an idling engine is on
    at power 0)."""
    power = np.asarray(power_w, dtype=np.float64)
    on = power > 0.0 if engine_on is None else engine_on
    if params.curve_fuel_kg_per_s:
        burning = np.interp(power, params.curve_power_w, params.curve_fuel_kg_per_s)
    else:
        burning = power / (efficiency(params, power) * params.fuel_lhv_j_per_kg)
    return np.where(on, np.maximum(burning, params.idle_fuel_kg_per_s), 0.0)


def best_power_w(params: EngineParams) -> float:
    """Power of best efficiency [W]: a knot, because either curve is piecewise linear."""
    knots_w = np.array(params.curve_power_w)
    return float(knots_w[int(np.argmax(efficiency(params, knots_w)))])


def power_range_w(
    params: EngineParams,
    engine_on: BoolArray,
    time_in_state_s: FloatArray,
    engine_power_w: FloatArray,
    dt_s: float,
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """What the engine can do in the coming step, each of shape (B,).

    Returns:
        Least and largest crankshaft power while on [W], and whether off is allowed. Where a
        start is not allowed yet both powers are 0.
    """
    ramp_w = params.ramp_w_per_s * dt_s
    present_w = np.where(engine_on, engine_power_w, 0.0)
    may_run = engine_on | (time_in_state_s >= params.min_off_s)
    least_w = np.where(may_run, np.maximum(present_w - ramp_w, 0.0), 0.0)
    most_w = np.where(may_run, np.minimum(present_w + ramp_w, params.power_max_w), 0.0)
    may_be_off = ~engine_on | (time_in_state_s >= params.min_on_s)
    return least_w, most_w, may_be_off
