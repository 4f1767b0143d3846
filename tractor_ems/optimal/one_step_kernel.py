"""The compiled decision of one step: least fuel, start and continuation over all engine powers.

Every policy that looks one step ahead differs from the others only in what it thinks a joule and
a running engine are worth afterwards; that enters as a parabola in battery power.
"""

import math
from typing import NamedTuple

from numba import njit

from tractor_ems.policies.genset import HOLD_ON_W
from tractor_ems.policies.one_step import (
    ALONE_SHARE,
    BESIDE_SHARE,
    COARSE,
    FINE,
    HEAVY_SHARE,
    HOLD_S,
    LEVELS,
    PEAK_FADE_S,
    RESTART_SHARE,
)
from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.batch_kernel import Bounds

FADE = math.exp(-1.0 / PEAK_FADE_S)
"""Of a remembered peak per step of 1 s."""


class Cell(NamedTuple):
    """Scalars of the battery that a decision needs."""

    ohm: float
    amps_per_soc: float
    unit_w: float


@njit(cache=True, error_model="numpy", forceinline=True)
def soc_change(cell: Cell, ocv_v: float, battery_w: float) -> float:
    """SOC after a step less SOC before it."""
    root_v = math.sqrt(max(ocv_v * ocv_v - 4.0 * cell.ohm * battery_w, 0.0))
    change: float = -2.0 * battery_w / (ocv_v + root_v) / cell.amps_per_soc
    return change


@njit(cache=True, error_model="numpy", forceinline=True)
def fuel_at(fuel_kg: FloatArray, engine_max_w: float, engine_w: float) -> float:
    """Fuel of one step of the running engine at a bus power, from a table over 0..max [kg]."""
    x = min(max(engine_w / engine_max_w, 0.0), 1.0) * (len(fuel_kg) - 1)
    m = min(int(x), len(fuel_kg) - 2)
    burnt: float = fuel_kg[m] + (x - m) * (fuel_kg[m + 1] - fuel_kg[m])
    return burnt


@njit(cache=True, error_model="numpy", forceinline=True)
def engine_range_w(b: Bounds, demand_w: float) -> tuple[float, float]:
    """Least and most bus power of a running engine, the battery kept off its limit [W]."""
    least_w = max(b.engine_least_w, demand_w - b.discharge_w, HOLD_ON_W)
    most_w = min(b.engine_w, demand_w + b.charge_w)
    support_w = min(demand_w - BESIDE_SHARE * b.discharge_w, most_w)
    least_w = max(least_w, support_w)
    return min(least_w, most_w), most_w


@njit(cache=True, error_model="numpy", forceinline=True)
def best_power_w(
    fuel_kg: FloatArray,
    engine_max_w: float,
    demand_w: float,
    least_w: float,
    most_w: float,
    unit_w: float,
    c0: float,
    c1: float,
    c2: float,
) -> tuple[float, float]:
    """Engine power of least fuel + c0 + c1 x + c2 x^2, x = battery power / unit, and that cost."""
    best, best_w = math.inf, most_w
    low, high, points = least_w, most_w, COARSE
    for _ in range(LEVELS):
        step = (high - low) / (points - 1)
        for i in range(points):
            engine_w = low + i * step
            x = (demand_w - engine_w) / unit_w
            cost = fuel_at(fuel_kg, engine_max_w, engine_w) + c0 + x * (c1 + x * c2)
            if cost < best:
                best, best_w = cost, engine_w
        low, high, points = max(best_w - step, least_w), min(best_w + step, most_w), FINE
    return best_w, best


class Held(NamedTuple):
    """The reserve's memory, as ``policies.one_step.Held``; ``since_s`` counts steps of 1 s."""

    peak_w: float
    since_s: float


NOT_HELD = Held(-1.0, 1e9)


@njit(cache=True, error_model="numpy", forceinline=True)
def hold(b: Bounds, ramp_w: float, demand_w: float, on: bool, held: Held) -> tuple[bool, Held]:
    """Whether the engine is to run whatever it costs, and the next memory; see
    ``policies.one_step.hold``. ``ramp_w``: what a restart gives after one step."""
    peak_w = held.peak_w * FADE if held.peak_w >= 0.0 else b.discharge_w + RESTART_SHARE * ramp_w
    peak_w = max(demand_w, peak_w)
    safe = demand_w <= HEAVY_SHARE * b.discharge_w
    since_s = held.since_s + 1.0 if safe else 0.0
    heavy = peak_w > ALONE_SHARE * b.discharge_w
    beyond = not safe if heavy else demand_w > ALONE_SHARE * b.discharge_w
    kept = on and heavy and since_s < HOLD_S
    return beyond or kept, Held(peak_w, since_s)


@njit(cache=True, error_model="numpy", forceinline=True)
def parabola(
    low_w: float, high_w: float, unit_w: float, y0: float, y1: float, y2: float
) -> tuple[float, float, float]:
    """c0, c1, c2 through values at low, middle and high battery power."""
    half = 0.5 * (high_w - low_w) / unit_w
    if half < 1e-6:
        return y1, 0.0, 0.0
    middle = 0.5 * (high_w + low_w) / unit_w
    slope, bend = 0.5 * (y2 - y0) / half, 0.5 * (y2 - 2.0 * y1 + y0) / half**2
    return y1 - slope * middle + bend * middle**2, slope - 2.0 * bend * middle, bend
