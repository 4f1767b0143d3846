"""What keeps demand met by policies that see no future, where a stopped engine is not back at
once: a battery that is not asked for its last, and an engine that is held while peaks are recent.
"""

import math

import numpy as np

from tractor_ems.policies.genset import HOLD_ON_W
from tractor_msgs_py.trajectory import BoolArray, FloatArray
from tractor_sim.generator import to_bus_w
from tractor_sim.powertrain import PowertrainParams

BATTERY_SHARE = 0.8
"""Share of its discharge limit up to which the battery is planned to carry demand alone. The rest
covers what demand can rise in a second beyond the engine's ramp (about 0.25 of rated power against
0.22)."""

BESIDE_ENGINE_SHARE = 0.6
"""The same beside a running engine, which costs nothing to use: at a pass's first seconds it ramps
as fast as it can."""

PEAK_TIME_S = 600.0
"""How slowly a peak is forgotten [s]: one of twice the battery's power after seven minutes, one
just above it soon. Passes with their turns take two, a loader's strokes one."""

NEXT_PEAK = 1.15
"""How much of the last peak the next may be: two standard deviations of 0.06-0.07 within the
measured passes."""


def starts_slowly(params: PowertrainParams) -> bool:
    """Whether an engine that was stopped cannot carry the load in the very next step."""
    engine = params.engine
    return engine.min_off_s > 0.0 or engine.ramp_w_per_s * params.dt_s < engine.power_max_w


def recent_peak_w(
    params: PowertrainParams, peak_w: FloatArray, power_demand_w: FloatArray
) -> FloatArray:
    """The larger of present demand and remembered peak, which fades; shape (B,), >= 0 [W]."""
    return np.maximum(power_demand_w, peak_w * math.exp(-params.dt_s / PEAK_TIME_S))


def beyond_battery_w(
    params: PowertrainParams, power_w: FloatArray, discharge_limit_w: FloatArray
) -> FloatArray:
    """What of ``power_w``, a demand or a peak, the engine should be there for, shape (B,) [W];
    at most 0 where the battery can carry it alone or the engine is there at once."""
    if not starts_slowly(params):
        return np.minimum(power_w, 0.0)
    return power_w - BATTERY_SHARE * discharge_limit_w


def support_w(
    params: PowertrainParams,
    power_demand_w: FloatArray,
    discharge_limit_w: FloatArray,
    engine_on: BoolArray,
) -> FloatArray:
    """Least bus power of an engine that is to keep the battery off its limit, shape (B,) [W];
    at most 0 where none is needed, an engine that is off staying so."""
    beyond_w = beyond_battery_w(params, power_demand_w, discharge_limit_w)
    beside_w = power_demand_w - BESIDE_ENGINE_SHARE * discharge_limit_w
    support = engine_on | (beyond_w > 0.0)
    return np.where(support & starts_slowly(params), beside_w, np.minimum(beyond_w, 0.0))


def must_hold(
    params: PowertrainParams, peak_w: FloatArray, discharge_limit_w: FloatArray
) -> BoolArray:
    """Whether stopping a running engine now risks unmet demand, shape (B,)."""
    return beyond_battery_w(params, peak_w, discharge_limit_w) > 0.0


def hold_power_w(
    params: PowertrainParams, peak_w: FloatArray, discharge_limit_w: FloatArray
) -> FloatArray:
    """Bus power at which a held engine waits, shape (B,) [W]: idling, or as much as it takes to
    meet the next peak within one step of the ramp."""
    engine = params.engine
    ramp_w = min(engine.ramp_w_per_s * params.dt_s, engine.power_max_w)
    step_w = float(to_bus_w(params.generator, np.array(ramp_w), engine.power_max_w))
    return np.maximum(NEXT_PEAK * peak_w - discharge_limit_w - step_w, HOLD_ON_W)
