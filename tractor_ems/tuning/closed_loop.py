"""Whole cycles driven in compiled code by policies that look one step ahead.

The plant is ``tractor_sim.batch_kernel``, bit for bit; one step is decided by
``optimal.one_step_kernel``. Three loops: a price of battery energy (ECMS), a table of values
(SDP), a network that says whether to run (DDQN).
"""

import math

import numpy as np
from numba import njit

from tractor_ems.optimal.one_step_kernel import (
    BATTERY_SHARE,
    Cell,
    best_power_w,
    engine_range_w,
    may_stand,
    parabola,
    soc_change,
)
from tractor_msgs_py.trajectory import FloatArray, IntArray
from tractor_sim.batch_kernel import Bounds, Plant, Segments, advance, bounds_of, fuel_of

FUEL, STARTS, SHORTFALL, SOC_FINAL, ON_STEPS, LOSS_J, SOC_LOW, SOC_HIGH, ENGINE_J = range(9)
"""Columns of the totals of a run."""

FADE = math.exp(-1.0 / 250.0)
"""Of a remembered peak per step: 250 kW is 205 kW, which battery and restart give together, after
50 s; a headland turn is shorter."""

RESTART_SHARE = 0.9
"""Share of one step's ramp that a restart is counted on for."""


@njit(cache=True, error_model="numpy")
def drive_ecms(
    plant: Plant, knots: FloatArray, segments: Segments, cell: Cell, fuel_kg: FloatArray,
    engine_max_w: float, demand_w: FloatArray, slow_w: FloatArray, soc0: float, target: float,
    settings: FloatArray, totals: FloatArray, trace: FloatArray,
) -> None:  # fmt: skip
    """settings: price [kg per J inside the battery], soc gain, adaptation per SOC and minute,
    start fuel over the time it is written off in [kg/s], 1 never to stop, price shift by slow
    demand [1/W] about the middle demand [W].

    ``slow_w``: the demand on which starting and stopping are decided.
    """
    price0, gain, adapt, hysteresis, never, tilt, centre_w = settings
    soc, on, time_s, engine_w, integral = soc0, False, 1e3, 0.0, 0.0
    totals[:] = 0.0
    totals[SOC_LOW] = totals[SOC_HIGH] = soc0
    peak_w, step_w, since = 0.0, RESTART_SHARE * plant.ramp_w, 1_000_000
    for t in range(len(demand_w)):
        d = demand_w[t]
        peak_w = max(d, peak_w * FADE)
        since += 1
        b = bounds_of(plant, knots, segments, soc, on, time_s, engine_w)
        since = 0 if d > BATTERY_SHARE * b.discharge_w else since
        seen = float(np.float32(soc))
        if adapt > 0.0 and t % 60 == 0 and t > 0:
            integral += adapt * (target - seen)
        bend = gain * (target - seen) + integral + tilt * (slow_w[t] - centre_w)
        per_soc = price0 * (1.0 + bend) * b.ocv_v * cell.amps_per_soc * plant.dt_s
        least, most = engine_range_w(b, d)
        low_w, high_w = d - most, d - least
        y0 = -per_soc * soc_change(cell, b.ocv_v, low_w)
        y1 = -per_soc * soc_change(cell, b.ocv_v, 0.5 * (low_w + high_w))
        y2 = -per_soc * soc_change(cell, b.ocv_v, high_w)
        c0, c1, c2 = parabola(low_w, high_w, cell.unit_w, y0, y1, y2)
        run_w, _ = best_power_w(fuel_kg, engine_max_w, d, least, most, cell.unit_w, c0, c1, c2)
        # Whether to run is asked of the slow demand, without the ramp limit.
        s = min(slow_w[t], b.discharge_w)
        wide_low, wide_high = max(s - engine_max_w, -b.charge_w), s - 1.0
        y0 = -per_soc * soc_change(cell, b.ocv_v, wide_low)
        y1 = -per_soc * soc_change(cell, b.ocv_v, 0.5 * (wide_low + wide_high))
        y2 = -per_soc * soc_change(cell, b.ocv_v, wide_high)
        c0, c1, c2 = parabola(wide_low, wide_high, cell.unit_w, y0, y1, y2)
        _, run_cost = best_power_w(
            fuel_kg, engine_max_w, s, s - wide_high, s - wide_low, cell.unit_w, c0, c1, c2
        )
        still_cost = -per_soc * soc_change(cell, b.ocv_v, s)
        edge = hysteresis * plant.dt_s
        wants = run_cost < still_cost + (edge if on else -edge)
        if never > 0.0:
            wants = on or run_cost < still_cost
        run = (wants or not may_stand(b, d, on, peak_w, step_w, since)) and b.engine_w > 0.0
        command_w = d - run_w if run else d
        off_w = np.nan if run else 0.0
        soc, on, time_s, engine_w = _apply(
            plant, knots, segments, cell, b, t, soc, on, time_s, d, command_w, off_w, totals, trace
        )
    totals[SOC_FINAL] = soc


@njit(cache=True, error_model="numpy")
def drive_table(
    plant: Plant, knots: FloatArray, segments: Segments, cell: Cell, fuel_kg: FloatArray,
    engine_max_w: float, demand_w: FloatArray, place: IntArray, soc0: float, target: float,
    price_kg: float, start_kg: float, gamma: float, offset: FloatArray, value: FloatArray,
    totals: FloatArray, trace: FloatArray,
) -> None:  # fmt: skip
    """``value`` (Z, S, 2): cost to come after a decision that led to SOC - target = ``offset``
    with the engine off or on [kg]; ``place`` (T,): which demand situation; ``price_kg``: of one
    unit of SOC."""
    soc, on, time_s, engine_w = soc0, False, 1e3, 0.0
    totals[:] = 0.0
    totals[SOC_LOW] = totals[SOC_HIGH] = soc0
    peak_w, step_w, since = 0.0, RESTART_SHARE * plant.ramp_w, 1_000_000
    for t in range(len(demand_w)):
        d = demand_w[t]
        peak_w = max(d, peak_w * FADE)
        since += 1
        b = bounds_of(plant, knots, segments, soc, on, time_s, engine_w)
        since = 0 if d > BATTERY_SHARE * b.discharge_w else since
        error = float(np.float32(soc)) - target
        least, most = engine_range_w(b, d)
        low_w, high_w = d - most, d - least
        z = place[t]
        y = np.empty(3)
        for i in range(3):
            change = soc_change(cell, b.ocv_v, low_w + 0.5 * i * (high_w - low_w))
            y[i] = gamma * _table(value, z, 1, offset, error + change) - price_kg * change
        c0, c1, c2 = parabola(low_w, high_w, cell.unit_w, y[0], y[1], y[2])
        run_w, run_cost = best_power_w(
            fuel_kg, engine_max_w, d, least, most, cell.unit_w, c0, c1, c2
        )
        change = soc_change(cell, b.ocv_v, min(d, b.discharge_w))
        still = gamma * _table(value, z, 0, offset, error + change) - price_kg * change
        wants = run_cost + (0.0 if on else start_kg) < still
        run = (wants or not may_stand(b, d, on, peak_w, step_w, since)) and b.engine_w > 0.0
        command_w = d - run_w if run else d
        off_w = np.nan if run else 0.0
        soc, on, time_s, engine_w = _apply(
            plant, knots, segments, cell, b, t, soc, on, time_s, d, command_w, off_w, totals, trace
        )
    totals[SOC_FINAL] = soc


@njit(cache=True, error_model="numpy")
def drive_choice(
    plant: Plant, knots: FloatArray, segments: Segments, cell: Cell, fuel_kg: FloatArray,
    engine_max_w: float, demand_w: FloatArray, inputs: FloatArray, soc0: float, target: float,
    price_kg: float, start_kg: float, unit_kg: float, soc_scale: float, slope_step: float,
    w0: FloatArray, b0: FloatArray, w1: FloatArray, b1: FloatArray, w2: FloatArray,
    b2: FloatArray, totals: FloatArray, trace: FloatArray,
) -> None:  # fmt: skip
    """A network of (V, G) over (inputs, SOC error), see ``learning.run_or_stand``; several of one
    shape may be laid one after another along the first axis of ``w0`` .. ``b2``: their mean
    decides."""
    soc, on, time_s, engine_w = soc0, False, 1e3, 0.0
    totals[:] = 0.0
    totals[SOC_LOW] = totals[SOC_HIGH] = soc0
    peak_w, step_w, since = 0.0, RESTART_SHARE * plant.ramp_w, 1_000_000
    nets, width, features = w0.shape[0], w0.shape[1], inputs.shape[1]
    first, hidden = np.empty(width), np.empty(width)
    v, g = np.empty(3), np.empty(3)
    for t in range(len(demand_w)):
        d = demand_w[t]
        peak_w = max(d, peak_w * FADE)
        since += 1
        b = bounds_of(plant, knots, segments, soc, on, time_s, engine_w)
        since = 0 if d > BATTERY_SHARE * b.discharge_w else since
        error = float(np.float32(soc)) - target
        v[:], g[:] = 0.0, 0.0
        for n in range(nets):
            for i in range(width):
                first[i] = b0[n, i]
                for j in range(features):
                    first[i] += w0[n, i, j] * inputs[t, j]
            for k in range(3):
                at = (error + (k - 1) * slope_step) / soc_scale
                for i in range(width):
                    hidden[i] = math.tanh(first[i] + w0[n, i, features] * at)
                out_v, out_g = b2[n, 0], b2[n, 1]
                for i in range(b1.shape[1]):
                    total = b1[n, i]
                    for j in range(width):
                        total += w1[n, i, j] * hidden[j]
                    total = math.tanh(total)
                    out_v += w2[n, 0, i] * total
                    out_g += w2[n, 1, i] * total
                v[k] += out_v / nets
                g[k] += out_g / nets
        low = min(v[0], v[0] - g[0])
        high = min(v[2], v[2] - g[2])
        per_soc = price_kg - (high - low) / (2.0 * slope_step) * unit_kg
        least, most = engine_range_w(b, d)
        low_w, high_w = d - most, d - least
        y0 = -per_soc * soc_change(cell, b.ocv_v, low_w)
        y1 = -per_soc * soc_change(cell, b.ocv_v, 0.5 * (low_w + high_w))
        y2 = -per_soc * soc_change(cell, b.ocv_v, high_w)
        c0, c1, c2 = parabola(low_w, high_w, cell.unit_w, y0, y1, y2)
        run_w, _ = best_power_w(fuel_kg, engine_max_w, d, least, most, cell.unit_w, c0, c1, c2)
        wants = g[1] < (0.0 if on else -start_kg / unit_kg)
        run = (wants or not may_stand(b, d, on, peak_w, step_w, since)) and b.engine_w > 0.0
        command_w = d - run_w if run else d
        off_w = np.nan if run else 0.0
        soc, on, time_s, engine_w = _apply(
            plant, knots, segments, cell, b, t, soc, on, time_s, d, command_w, off_w, totals, trace
        )
    totals[SOC_FINAL] = soc


@njit(cache=True, error_model="numpy", forceinline=True)
def _table(value: FloatArray, z: int, on: int, offset: FloatArray, error: float) -> float:
    x = (error - offset[0]) / (offset[1] - offset[0])
    j = min(max(int(x), 0), len(offset) - 2)
    left, right = value[z, j, on], value[z, j + 1, on]
    found: float = left + (x - j) * (right - left)
    return found


@njit(cache=True, error_model="numpy")
def _apply(
    plant: Plant, knots: FloatArray, segments: Segments, cell: Cell, b: Bounds, t: int,
    soc: float, on: bool, time_s: float, d: float, command_w: float, off_w: float,
    totals: FloatArray, trace: FloatArray,
) -> tuple[float, bool, float, float]:  # fmt: skip
    r = advance(plant, b, soc, on, time_s, d, command_w, off_w)
    totals[FUEL] += fuel_of(plant, knots, segments, r.engine_power_w, r.engine_on, r.started)
    totals[STARTS] += r.started
    totals[SHORTFALL] += r.shortfall_j
    totals[ON_STEPS] += r.engine_on
    amps = (soc - r.soc) * cell.amps_per_soc
    totals[LOSS_J] += cell.ohm * amps * amps * plant.dt_s
    totals[ENGINE_J] += r.engine_power_w * plant.dt_s
    totals[SOC_LOW] = min(totals[SOC_LOW], r.soc)
    totals[SOC_HIGH] = max(totals[SOC_HIGH], r.soc)
    if len(trace):
        trace[t, 0], trace[t, 1], trace[t, 2] = r.soc, r.engine_power_w, r.engine_on
    return r.soc, r.engine_on, r.time_in_state_s, r.engine_power_w
