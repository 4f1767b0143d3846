"""Engine: fuel against power, and the start and ramp logic around it.

The efficiency curve is piecewise linear over power at the crankshaft; off burns nothing.
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
        curve_power_w: knots of the efficiency curve, increasing from 0 to power_max_w [W].
        curve_efficiency: efficiency at the knots, 0 < value < 1.
        fuel_lhv_j_per_kg: lower heating value [J/kg].
        idle_fuel_kg_per_s: least fuel rate while on [kg/s].
        start_fuel_kg: fuel of one start [kg].
        min_on_s, min_off_s: least time in a state before it may be left [s].
        ramp_w_per_s: largest change of power while on, inf for none [W/s].
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
        power, efficiency = np.array(self.curve_power_w), np.array(self.curve_efficiency)
        if len(power) < 2 or len(power) != len(efficiency):
            raise ConfigError(
                f"engine.curve_power_w: {len(power)} powers, {len(efficiency)} efficiencies, "
                "at least 2 of each in equal number"
            )
        if power[0] != 0.0 or not np.all(np.diff(power) > 0):
            raise ConfigError("engine.curve_power_w: must start at 0 and increase")
        if power[-1] != self.power_max_w:
            raise ConfigError(
                f"engine.curve_power_w: ends at {power[-1]} W, power_max_w is {self.power_max_w}"
            )
        if not np.all((efficiency > 0) & (efficiency < 1)):
            raise ConfigError("engine.curve_efficiency: every value must lie in 0 < value < 1")


def efficiency(params: EngineParams, power_w: FloatArray) -> FloatArray:
    """Crankshaft efficiency at ``power_w`` (any shape), clamped to the curve's ends."""
    return np.interp(power_w, params.curve_power_w, params.curve_efficiency)


def fuel_rate_kg_per_s(
    params: EngineParams, power_w: FloatArray, engine_on: BoolArray | None = None
) -> FloatArray:
    """Fuel rate [kg/s]: P / (eta(P) * LHV), at least the idle rate; an engine that is off burns
    nothing. ``engine_on`` defaults to ``power_w > 0`` (an idling engine is on at power 0)."""
    power = np.asarray(power_w, dtype=np.float64)
    on = power > 0.0 if engine_on is None else engine_on
    burning = power / (efficiency(params, power) * params.fuel_lhv_j_per_kg)
    return np.where(on, np.maximum(burning, params.idle_fuel_kg_per_s), 0.0)


def best_power_w(params: EngineParams) -> float:
    """Power of best efficiency [W]; a knot, because the curve is piecewise linear."""
    return float(params.curve_power_w[int(np.argmax(params.curve_efficiency))])


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
