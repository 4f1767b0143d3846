"""Stretches of recorded demand that an engine runs or stands through: what they cost and where
they lead. Compiled: hundreds per gradient step.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from tractor_ems.optimal.one_step_kernel import (
    NOT_HELD,
    Cell,
    best_power_w,
    fuel_at,
    hold,
    parabola,
    soc_change,
)
from tractor_ems.policies.genset import HOLD_ON_W
from tractor_ems.policies.one_step import BESIDE_SHARE
from tractor_msgs_py.trajectory import BoolArray, FloatArray, IntArray
from tractor_sim.batch_kernel import Bounds


@njit(cache=True, error_model="numpy", forceinline=True)
def held_kg(settings: FloatArray, error: float) -> float:
    """Holding cost of one step [kg]; ``settings``: quadratic, wall, its place, most."""
    far = (error / settings[2]) ** 4
    cost = settings[0] * error * error + settings[1] * far * far * far * far
    held: float = min(cost, settings[3])
    return held


@njit(cache=True, error_model="numpy", forceinline=True)
def power_at_price(
    cell: Cell, fuel_kg: FloatArray, engine_max_w: float, ocv_v: float, demand_w: float,
    least_w: float, most_w: float, per_soc_kg: float,
) -> float:  # fmt: skip
    """Engine power of least fuel less SOC gained at a price [W]."""
    low_w, high_w = demand_w - most_w, demand_w - least_w
    y0 = -per_soc_kg * soc_change(cell, ocv_v, low_w)
    y1 = -per_soc_kg * soc_change(cell, ocv_v, 0.5 * (low_w + high_w))
    y2 = -per_soc_kg * soc_change(cell, ocv_v, high_w)
    c0, c1, c2 = parabola(low_w, high_w, cell.unit_w, y0, y1, y2)
    best_w, _ = best_power_w(
        fuel_kg, engine_max_w, demand_w, least_w, most_w, cell.unit_w, c0, c1, c2
    )
    return best_w


@njit(cache=True, error_model="numpy")
def stretches(
    cell: Cell, fuel_kg: FloatArray, engine_max_w: float, limit_w: float, ocv_v: float,
    demand_w: FloatArray, baseline_kg: FloatArray, tick: IntArray, steps: IntArray,
    error: FloatArray, slope_kg: FloatArray, price_kg: float, start_kg: float, gamma: float,
    min_off: int, ramp_w: float, short_kg_per_w: float, holding: FloatArray,
    must_start: BoolArray, cost: FloatArray, end: FloatArray, end_on: FloatArray,
) -> None:  # fmt: skip
    """Cost (B, 2) of running and standing from ``tick`` for so many ``steps``, SOC errors after
    them, and whether the engine runs then; what stands is started where ``must_start``
    says so, as fast as the real engine can. inf: it cannot stand at all."""
    for i in range(len(tick)):
        per_soc = price_kg - slope_kg[i]
        for way in range(2):
            e, on, total, weight = error[i], way == 0, 0.0, 1.0
            ready_w = engine_max_w  # what the engine can give: less after a restart
            for k in range(steps[i]):
                d = demand_w[tick[i] + k]
                if not on and must_start[tick[i] + k]:
                    if k == 0:
                        total = np.inf
                        break
                    if k >= min_off:
                        on, total, ready_w = True, total + weight * start_kg, 0.0
                ready_w = min(ready_w + ramp_w, engine_max_w)
                # Demand that a late or slow restart leaves unmet.
                short_w = max(d - limit_w - (ready_w if on else 0.0), 0.0)
                total += weight * short_w * short_kg_per_w
                change, burnt = 0.0, 0.0
                if on:
                    least = max(d - BESIDE_SHARE * limit_w, HOLD_ON_W)
                    most = max(min(ready_w, d + limit_w), HOLD_ON_W)
                    least = min(least, most)
                    engine_w = power_at_price(
                        cell, fuel_kg, engine_max_w, ocv_v, d, least, most, per_soc
                    )
                    burnt = fuel_at(fuel_kg, engine_max_w, engine_w)
                    change = soc_change(cell, ocv_v, min(d - engine_w, limit_w))
                else:
                    change = soc_change(cell, ocv_v, min(max(d, -limit_w), limit_w))
                step = burnt - price_kg * change + held_kg(holding, e)
                total += weight * (step - baseline_kg[tick[i] + k])
                e += change
                weight *= gamma
            cost[i, way], end[i, way], end_on[i, way] = total, e, on


class Reserve(NamedTuple):
    """What ``policies.one_step.hold`` says at every tick of a trace, (T,): whether an engine that
    stands must start, whether one that runs must go on, and what it remembers then."""

    must_start: BoolArray
    must_run: BoolArray
    peak_w: FloatArray
    since_s: FloatArray


def reserve(demand_w: FloatArray, limit_w: float, ramp_w: float, slow: bool) -> Reserve:
    """The reserve along demand, the battery's limit being what it mostly is; steps of 1 s.
    An engine that is not ``slow`` needs none."""
    steps = len(demand_w)
    found = Reserve(
        np.zeros(steps, dtype=np.bool_), np.zeros(steps, dtype=np.bool_),
        np.full(steps, NOT_HELD.peak_w), np.full(steps, NOT_HELD.since_s),
    )  # fmt: skip
    if slow:
        _reserve(demand_w, limit_w, ramp_w, *found)
    return found


@njit(cache=True, error_model="numpy")
def _reserve(
    demand_w: FloatArray, limit_w: float, ramp_w: float, must_start: BoolArray,
    must_run: BoolArray, peak_w: FloatArray, since_s: FloatArray,
) -> None:  # fmt: skip
    held, bounds = NOT_HELD, Bounds(limit_w, limit_w, 0.0, 0.0, True, 0.0)
    for t in range(len(demand_w)):
        must_start[t], _ = hold(bounds, ramp_w, demand_w[t], False, held)
        must_run[t], held = hold(bounds, ramp_w, demand_w[t], True, held)
        peak_w[t], since_s[t] = held.peak_w, held.since_s


def baseline(
    cell: Cell, fuel_kg: FloatArray, engine_max_w: float, limit_w: float, ocv_v: float,
    demand_w: FloatArray, price_kg: float,
) -> FloatArray:  # fmt: skip
    """Least fuel and price of battery energy of a running engine at every demand [kg]."""
    found = np.empty(len(demand_w))
    _baseline(cell, fuel_kg, engine_max_w, limit_w, ocv_v, demand_w, price_kg, found)
    return found


@njit(cache=True, error_model="numpy")
def _baseline(
    cell: Cell, fuel_kg: FloatArray, engine_max_w: float, limit_w: float, ocv_v: float,
    demand_w: FloatArray, price_kg: float, found: FloatArray,
) -> None:  # fmt: skip
    for i in range(len(demand_w)):
        d = demand_w[i]
        most = max(min(engine_max_w, d + limit_w), HOLD_ON_W)
        least = min(max(d - BESIDE_SHARE * limit_w, HOLD_ON_W), most)
        engine_w = power_at_price(cell, fuel_kg, engine_max_w, ocv_v, d, least, most, price_kg)
        change = soc_change(cell, ocv_v, d - engine_w)
        found[i] = fuel_at(fuel_kg, engine_max_w, engine_w) - price_kg * change
