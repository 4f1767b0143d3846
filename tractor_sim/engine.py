"""Engine: fuel against power, and the start and ramp logic around it.

Either the efficiency or the fuel rate is piecewise linear over power at the crankshaft; off burns
nothing.
"""

from dataclasses import dataclass

import numpy as np

from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.trajectory import BoolArray, FloatArray
from tractor_sim.knots import check_entries, check_rising

TIME_ROUNDING_S = 1e-6
"""A time in state is a sum of steps: this much below a minimum time is rounding."""


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
            raise ConfigError(
                "engine.curve_efficiency, curve_fuel_kg_per_s: both given, allowed one"
            )
        if len(power) < 2 or len(power) != len(values):
            raise ConfigError(
                f"engine.curve_power_w: {len(power)} powers, {len(values)} {name}, "
                "at least 2 of each in equal number"
            )
        if power[0] != 0.0:
            raise ConfigError(f"engine.curve_power_w.0: {float(power[0])}, allowed 0")
        check_rising("engine.curve_power_w", power)
        if power[-1] != self.power_max_w:
            raise ConfigError(
                f"engine.curve_power_w.{len(power) - 1}: {float(power[-1])}, allowed "
                f"engine.power_max_w, {self.power_max_w}"
            )
        if not len(fuel):
            good = (eta > 0) & (eta < 1)
            check_entries("engine.curve_efficiency", eta, good, "0 < value < 1")
            return
        check_fuel_knots("engine.curve_fuel_kg_per_s", power, fuel, self.fuel_lhv_j_per_kg)
        check_rising("engine.curve_fuel_kg_per_s", fuel)


def check_fuel_knots(
    field: str, power_w: FloatArray, fuel_kg_per_s: FloatArray, fuel_lhv_j_per_kg: float
) -> None:
    """Refuse a fuel rate, shapes (K,), that is below 0 or gives an efficiency of 1 or more.

    Raises:
        ConfigError: so; the message names the entry of ``field``, its value and what is allowed.
    """
    least = power_w / fuel_lhv_j_per_kg
    good = np.where(power_w > 0.0, fuel_kg_per_s > least, fuel_kg_per_s >= 0.0)
    if not np.all(good):
        k = int(np.argmin(good))
        allowed = (
            f"> {least[k]:.6g} at {power_w[k]:g} W: power / engine.fuel_lhv_j_per_kg "
            f"({fuel_lhv_j_per_kg:g}), an efficiency below 1"
        )
        check_entries(field, fuel_kg_per_s, good, allowed if power_w[k] > 0.0 else ">= 0")


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
    waited_s = time_in_state_s + TIME_ROUNDING_S
    may_run = engine_on | (waited_s >= params.min_off_s)
    least_w = np.where(may_run, np.maximum(present_w - ramp_w, 0.0), 0.0)
    most_w = np.where(may_run, np.minimum(present_w + ramp_w, params.power_max_w), 0.0)
    may_be_off = ~engine_on | (waited_s >= params.min_on_s)
    return least_w, most_w, may_be_off
