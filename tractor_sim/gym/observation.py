"""What a policy sees: numbers of about one, and what each means in SI units."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.generator import to_bus_w
from tractor_sim.powertrain import PlantState, PowerLimits, PowertrainParams

FAST_S, SLOW_S = 10.0, 300.0
"""Time constants of the two running means of demand."""

LONG_S = 60.0
"""Time in state that is seen as 1; longer is 1 too."""

DEMAND_RANGE = 4.0
"""Demand beyond this many engine powers is seen as this."""

ELEMENTS: tuple[tuple[str, float, float], ...] = (
    ("demand", -DEMAND_RANGE, DEMAND_RANGE),
    ("demand_fast_mean", -DEMAND_RANGE, DEMAND_RANGE),
    ("demand_slow_mean", -DEMAND_RANGE, DEMAND_RANGE),
    ("soc_minus_target", -1.0, 1.0),
    ("soc_in_window", 0.0, 1.0),
    ("engine_on", 0.0, 1.0),
    ("engine_power", 0.0, 1.0),
    ("time_in_state", 0.0, 1.0),
    ("charge_limit", 0.0, 1.0),
    ("discharge_limit", 0.0, 1.0),
    ("engine_limit", 0.0, 1.0),
    ("engine_least", 0.0, 1.0),
    ("may_be_off", 0.0, 1.0),
)
"""Name, least and largest value, in the order of the observation."""

_BOUNDS = (
    np.array([low for _, low, _ in ELEMENTS], dtype=np.float32),
    np.array([high for _, _, high in ELEMENTS], dtype=np.float32),
)


@dataclass(frozen=True)
class Scales:
    """What 1 means: the engine's largest bus power and the battery's power limit [W], the SOC
    window (a fraction), and its lower end."""

    engine_w: float
    battery_w: float
    soc_window: float
    soc_min: float


def make_scales(params: PowertrainParams) -> Scales:
    """Scales of a powertrain."""
    peak_w, battery = params.engine.power_max_w, params.battery
    return Scales(
        float(to_bus_w(params.generator, np.array(peak_w), peak_w)),
        battery.power_max_w,
        battery.soc_max - battery.soc_min,
        battery.soc_min,
    )


def bounds() -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Least and largest observation."""
    return _BOUNDS[0].copy(), _BOUNDS[1].copy()


def running_mean(
    mean_w: FloatArray, power_demand_w: FloatArray, dt_s: float, constant_s: float
) -> FloatArray:
    """Exponential mean after one more step: it goes 1 - exp(-dt / tau) of the way."""
    after: FloatArray = mean_w - (power_demand_w - mean_w) * np.expm1(-dt_s / constant_s)
    return after


def observe(
    scales: Scales,
    state: PlantState,
    limits: PowerLimits,
    power_demand_w: FloatArray,
    fast_mean_w: FloatArray,
    slow_mean_w: FloatArray,
    soc_target: FloatArray,
) -> NDArray[np.float32]:
    """Observations of B plants, (B, 13), within :func:`bounds`; arguments (B,)."""
    columns = (
        power_demand_w / scales.engine_w,
        fast_mean_w / scales.engine_w,
        slow_mean_w / scales.engine_w,
        (state.soc - soc_target) / scales.soc_window,
        (state.soc - scales.soc_min) / scales.soc_window,
        state.engine_on,
        state.engine_power_w / scales.engine_w,
        state.time_in_state_s / LONG_S,
        limits.charge_w / scales.battery_w,
        limits.discharge_w / scales.battery_w,
        limits.engine_w / scales.engine_w,
        limits.engine_least_w / scales.engine_w,
        limits.may_be_off,
    )
    seen = np.empty((len(power_demand_w), len(columns)), dtype=np.float32)
    for k, column in enumerate(columns):
        seen[:, k] = column
    return np.clip(seen, *_BOUNDS, out=seen)
