"""Whole cycles driven in compiled code by policies that look one step ahead.

The plant is ``tractor_sim.batch_kernel``, bit for bit; one step is decided by
``optimal.one_step_kernel``. One loop body (:func:`_look`, what a policy wants, :func:`_finish`)
for three of them: a price of battery energy (ECMS), a table of values (SDP), a network that says
whether to run (DDQN).
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from tractor_ems.optimal.one_step_kernel import (
    NOT_HELD,
    Cell,
    Held,
    best_power_w,
    engine_range_w,
    hold,
    parabola,
    soc_change,
)
from tractor_ems.policies.genset import HOLD_ON_W
from tractor_ems.policies.one_step import HOLD_S
from tractor_ems.policies.run_or_stand import FAR_SOC
from tractor_msgs_py.trajectory import FloatArray, IntArray
from tractor_sim.batch_kernel import Bounds, Plant, Segments, advance, bounds_of, fuel_of

FUEL, STARTS, SHORTFALL, SOC_FINAL, ON_STEPS, LOSS_J, SOC_LOW, SOC_HIGH, ENGINE_J = range(9)
"""Columns of the totals of a run."""

BEND_MOST = 1.0
"""Most that SOC feedback raises or lowers a price of battery energy, relative to it."""


class Run(NamedTuple):
    """What a run carries from step to step: the plant, whether its engine is to run in this step,
    and what the reserve remembers."""

    soc: float
    on: bool
    time_s: float
    engine_w: float
    must: bool
    held: Held


@njit(cache=True, error_model="numpy")
def drive_ecms(
    plant: Plant, knots: FloatArray, segments: Segments, cell: Cell, fuel_kg: FloatArray,
    engine_max_w: float, demand_w: FloatArray, slow_w: FloatArray, left_s: FloatArray,
    soc0: float, target: float, settings: FloatArray, totals: FloatArray, trace: FloatArray,
) -> None:  # fmt: skip
    """settings: price [kg per J inside the battery], soc gain, adaptation per SOC and minute,
    start fuel over the time it is written off in [kg/s], 1 never to stop, stiffening of the soc
    gain towards the end [s].

    ``slow_w``: the demand on which starting and stopping are decided; ``left_s``: time to the
    planned end at every step, inf where none is.
    """
    price0, gain, adapt, hysteresis, never, stiffen_s = settings
    run, integral = _begin(soc0, totals), 0.0
    for t in range(len(demand_w)):
        d = demand_w[t]
        run, b = _look(plant, knots, segments, run, d)
        error = target - float(np.float32(run.soc))
        if adapt > 0.0 and t % 60 == 0 and t > 0:
            integral += adapt * error
        bend = (gain + stiffen_s / max(left_s[t], plant.dt_s)) * error + integral
        bend = min(max(bend, -BEND_MOST), BEND_MOST)
        per_soc = price0 * (1.0 + bend) * b.ocv_v * cell.amps_per_soc * plant.dt_s
        least, most = engine_range_w(b, d)
        run_w, _ = _at_price(cell, fuel_kg, engine_max_w, b.ocv_v, d, least, most, per_soc)
        # Whether to run is asked of the slow demand, without the ramp limit.
        s = min(slow_w[t], b.discharge_w)
        most = min(engine_max_w, s + b.charge_w)
        _, run_cost = _at_price(cell, fuel_kg, engine_max_w, b.ocv_v, s, HOLD_ON_W, most, per_soc)
        still_cost = -per_soc * soc_change(cell, b.ocv_v, s)
        edge = hysteresis * plant.dt_s
        wants = run_cost < still_cost + (edge if run.on else -edge)
        if never > 0.0:
            wants = run.on or run_cost < still_cost
        run = _finish(plant, knots, segments, cell, run, b, t, d, wants, run_w, totals, trace)


@njit(cache=True, error_model="numpy")
def drive_table(
    plant: Plant, knots: FloatArray, segments: Segments, cell: Cell, fuel_kg: FloatArray,
    engine_max_w: float, demand_w: FloatArray, place: IntArray, left_s: FloatArray, soc0: float,
    target: float, price_kg: float, start_kg: float, gamma: float, times_s: FloatArray,
    offset: FloatArray, values: FloatArray, totals: FloatArray, trace: FloatArray,
) -> None:  # fmt: skip
    """``values`` (K, Z, S, 2): cost to come, ``times_s`` (K,) before the planned end, after a
    decision that led to SOC - target = ``offset`` with the engine off or on [kg]; ``place`` (T,):
    which demand situation; ``left_s`` (T,): time to the planned end before the decision;
    ``price_kg``: of one unit of SOC."""
    run, y = _begin(soc0, totals), np.empty(3)
    for t in range(len(demand_w)):
        d, z = demand_w[t], place[t]
        run, b = _look(plant, knots, segments, run, d)
        error = float(np.float32(run.soc)) - target
        k, share = _between(times_s, left_s[t] - plant.dt_s)
        least, most = engine_range_w(b, d)
        low_w, high_w = d - most, d - least
        for i in range(3):
            change = soc_change(cell, b.ocv_v, low_w + 0.5 * i * (high_w - low_w))
            after = _table(values, k, share, z, 1, offset, error + change)
            y[i] = gamma * after - price_kg * change
        c0, c1, c2 = parabola(low_w, high_w, cell.unit_w, y[0], y[1], y[2])
        run_w, run_cost = best_power_w(
            fuel_kg, engine_max_w, d, least, most, cell.unit_w, c0, c1, c2
        )
        change = soc_change(cell, b.ocv_v, min(d, b.discharge_w))
        after = _table(values, k, share, z, 0, offset, error + change)
        still = gamma * after - price_kg * change
        wants = run_cost + (0.0 if run.on else start_kg) < still
        run = _finish(plant, knots, segments, cell, run, b, t, d, wants, run_w, totals, trace)


@njit(cache=True, error_model="numpy")
def drive_choice(
    plant: Plant, knots: FloatArray, segments: Segments, cell: Cell, fuel_kg: FloatArray,
    engine_max_w: float, demand_w: FloatArray, inputs: FloatArray, at: int,
    stiff_kg: FloatArray, soc0: float, target: float, price_kg: float, start_kg: float,
    unit_kg: float, soc_scale: float, slope_step: float, w0: FloatArray, b0: FloatArray,
    w1: FloatArray, b1: FloatArray, w2: FloatArray, b2: FloatArray, totals: FloatArray,
    trace: FloatArray,
) -> None:  # fmt: skip
    """A network of (V, G) over (inputs, SOC error), see ``learning.run_or_stand``; several of one
    shape may be laid one after another along the first axis of ``w0`` .. ``b2``: their mean
    decides. ``inputs`` (T, n): all but the SOC error; columns ``at`` and ``at`` + 1 are filled in
    here with what the reserve remembers. ``stiff_kg`` (T,): the known part of V per SOC error
    squared [kg]."""
    run = _begin(soc0, totals)
    nets, width, features = w0.shape[0], w0.shape[1], inputs.shape[1]
    first, hidden = np.empty(width), np.empty(width)
    v, g = np.empty(3), np.empty(3)
    for t in range(len(demand_w)):
        d = demand_w[t]
        run, b = _look(plant, knots, segments, run, d)
        error = float(np.float32(run.soc)) - target
        inputs[t, at] = min(max(run.held.peak_w / cell.unit_w - 1.0, -1.0), 1.0)
        inputs[t, at + 1] = math.exp(-run.held.since_s / HOLD_S)
        v[:], g[:] = 0.0, 0.0
        for n in range(nets):
            for i in range(width):
                first[i] = b0[n, i]
                for j in range(features):
                    first[i] += w0[n, i, j] * inputs[t, j]
            for k in range(3):
                place = error + (k - 1) * slope_step
                near, far = place / soc_scale, (place / FAR_SOC) ** 5
                for i in range(width):
                    hidden[i] = math.tanh(
                        first[i] + w0[n, i, features] * near + w0[n, i, features + 1] * far
                    )
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
        low = v[0] if run.must else min(v[0], v[0] - g[0])
        high = v[2] if run.must else min(v[2], v[2] - g[2])
        per_soc = price_kg - (high - low) / (2.0 * slope_step) * unit_kg
        per_soc -= 2.0 * stiff_kg[t] * error
        least, most = engine_range_w(b, d)
        run_w, _ = _at_price(cell, fuel_kg, engine_max_w, b.ocv_v, d, least, most, per_soc)
        wants = g[1] < (0.0 if run.on else -start_kg / unit_kg)
        run = _finish(plant, knots, segments, cell, run, b, t, d, wants, run_w, totals, trace)


@njit(cache=True, error_model="numpy", forceinline=True)
def _at_price(
    cell: Cell, fuel_kg: FloatArray, engine_max_w: float, ocv_v: float, demand_w: float,
    least_w: float, most_w: float, per_soc: float,
) -> tuple[float, float]:  # fmt: skip
    """Engine power of least fuel less SOC gained at a price, and that cost."""
    low_w, high_w = demand_w - most_w, demand_w - least_w
    y0 = -per_soc * soc_change(cell, ocv_v, low_w)
    y1 = -per_soc * soc_change(cell, ocv_v, 0.5 * (low_w + high_w))
    y2 = -per_soc * soc_change(cell, ocv_v, high_w)
    c0, c1, c2 = parabola(low_w, high_w, cell.unit_w, y0, y1, y2)
    return best_power_w(fuel_kg, engine_max_w, demand_w, least_w, most_w, cell.unit_w, c0, c1, c2)


@njit(cache=True, error_model="numpy", forceinline=True)
def _between(times_s: FloatArray, left_s: float) -> tuple[int, float]:
    """Which two tables to mix, and the share of the later one; the farthest beyond the last."""
    last = len(times_s) - 1
    if left_s >= times_s[last]:
        return last, 0.0
    k = 0
    while times_s[k + 1] <= left_s:
        k += 1
    return k, max(left_s - times_s[k], 0.0) / (times_s[k + 1] - times_s[k])


@njit(cache=True, error_model="numpy", forceinline=True)
def _table(
    values: FloatArray, k: int, share: float, z: int, on: int, offset: FloatArray, error: float
) -> float:
    x = (error - offset[0]) / (offset[1] - offset[0])
    j = min(max(int(x), 0), len(offset) - 2)
    left, right = values[k, z, j, on], values[k, z, j + 1, on]
    found: float = left + (x - j) * (right - left)
    if share > 0.0:
        left, right = values[k + 1, z, j, on], values[k + 1, z, j + 1, on]
        found += share * (left + (x - j) * (right - left) - found)
    return found


@njit(cache=True, error_model="numpy", forceinline=True)
def _begin(soc0: float, totals: FloatArray) -> Run:
    totals[:] = 0.0
    totals[SOC_LOW] = totals[SOC_HIGH] = totals[SOC_FINAL] = soc0
    return Run(soc0, False, 1e3, 0.0, False, NOT_HELD)


@njit(cache=True, error_model="numpy", forceinline=True)
def _look(
    plant: Plant, knots: FloatArray, segments: Segments, run: Run, d: float
) -> tuple[Run, Bounds]:
    """What is possible in this step, and what demand ``d`` adds to the memory."""
    b = bounds_of(plant, knots, segments, run.soc, run.on, run.time_s, run.engine_w)
    must, held = hold(b, min(plant.ramp_w, plant.power_max_w), d, run.on, run.held)
    return Run(run.soc, run.on, run.time_s, run.engine_w, must, held), b


@njit(cache=True, error_model="numpy")
def _finish(
    plant: Plant, knots: FloatArray, segments: Segments, cell: Cell, run: Run, b: Bounds, t: int,
    d: float, wants: bool, run_w: float, totals: FloatArray, trace: FloatArray,
) -> Run:  # fmt: skip
    """Run at ``run_w`` or stand: as wanted, where the engine may stand and may run at all."""
    runs = (wants or run.must or not b.may_be_off) and b.engine_w > 0.0
    command_w, off_w = (d - run_w, np.nan) if runs else (d, 0.0)
    r = advance(plant, b, run.soc, run.on, run.time_s, d, command_w, off_w)
    totals[FUEL] += fuel_of(plant, knots, segments, r.engine_power_w, r.engine_on, r.started)
    totals[STARTS] += r.started
    totals[SHORTFALL] += r.shortfall_j
    totals[ON_STEPS] += r.engine_on
    amps = (run.soc - r.soc) * cell.amps_per_soc
    totals[LOSS_J] += cell.ohm * amps * amps * plant.dt_s
    totals[ENGINE_J] += r.engine_power_w * plant.dt_s
    totals[SOC_FINAL] = r.soc
    totals[SOC_LOW] = min(totals[SOC_LOW], r.soc)
    totals[SOC_HIGH] = max(totals[SOC_HIGH], r.soc)
    if len(trace):
        trace[t, 0], trace[t, 1], trace[t, 2] = r.soc, r.engine_power_w, r.engine_on
    return Run(r.soc, r.engine_on, r.time_in_state_s, r.engine_power_w, run.must, run.held)
