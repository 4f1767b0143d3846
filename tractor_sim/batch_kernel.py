"""One plant step compiled: the physics of ``tractor_sim.powertrain.step``, scalar by scalar.

Knows numbers and tables only and takes every constant from them: :mod:`tractor_sim.batch` fills
them in. Same operations in the same order as the numpy step, so that both give the same bits.

Written without branches that depend on a plant's state: none of them could be predicted, and
around each the compiler would count references to the tables. What a state rules out is computed
and not taken. Indices are unsigned, which spares a check of their sign.
"""

import math
from typing import NamedTuple, TypeAlias

import numpy as np
from numba import njit
from numpy.typing import NDArray

from tractor_msgs_py.trajectory import BoolArray, FloatArray

Segments: TypeAlias = NDArray[np.uint32]


_COLUMNS, _Y, _SLOPE, _NEXT = np.uintp(4), np.uintp(1), np.uintp(2), np.uintp(1)
"""A knot takes four numbers: x, y, slope up to the next knot, nothing."""

BLOCK = 256
"""Plants that are stepped together: what they need fits a processor's first cache."""


class Curve(NamedTuple):
    """Where a piecewise linear curve stands in the tables.

    ``knots`` has the knots of a curve one after another and then one at x = inf. ``segments``
    has, for equal bins from ``first_x`` to ``last_x``, the row of the last knot at or below each
    bin's left end; no two bins side by side hold two knots. So a value is found without a search,
    then interpolated exactly.

    Attributes:
        first_x, last_x: outermost knots.
        bin: place of the first bin.
        bins_per_x: bins per unit of x.
    """

    first_x: float
    last_x: float
    bin: int
    bins_per_x: float


class Plant(NamedTuple):
    """A powertrain as numbers; units as in ``PowertrainParams``. Its tables go beside it: arrays
    within a tuple would be counted in and out at every use, by all threads at one counter.

    Attributes:
        bus_of_crank, crank_of_bus: generator [W].
        curve: fuel rate [kg/s] (``fuel_curve``) or efficiency over crankshaft power.
        ocv: open-circuit voltage over SOC [V].
        rounding_w: bus imbalance that counts as none.
    """

    dt_s: float
    rounding_w: float
    power_max_w: float
    lhv_j_per_kg: float
    idle_fuel_kg_per_s: float
    start_fuel_kg: float
    min_on_s: float
    min_off_s: float
    ramp_w: float
    fuel_curve: bool
    curve: Curve
    bus_of_crank: Curve
    crank_of_bus: Curve
    lossless: bool
    energy_j: float
    charge_c: float
    battery_max_w: float
    soc_min: float
    soc_max: float
    ocv: Curve
    resistance_ohm: float
    charge_max_a: float
    discharge_max_a: float


@njit(cache=True, error_model="numpy", forceinline=True)
def _least(a: float, b: float) -> float:
    return a if a < b else b


@njit(cache=True, error_model="numpy", forceinline=True)
def _most(a: float, b: float) -> float:
    return a if a > b else b


@njit(cache=True, error_model="numpy", forceinline=True)
def _at(curve: Curve, knots: FloatArray, segments: Segments, x: float) -> float:
    """np.interp on the curve. A NaN counts as the first x, so that no index is wild."""
    inside = _least(_most(x, curve.first_x), curve.last_x)
    place = np.uintp((inside - curve.first_x) * curve.bins_per_x)
    row = np.uintp(segments[np.uintp(curve.bin) + place])
    row += np.uintp(knots[_COLUMNS * (row + _NEXT)] <= inside)
    k = _COLUMNS * row
    return knots[k + _SLOPE] * (inside - knots[k]) + knots[k + _Y]  # type: ignore[no-any-return]


class Bounds(NamedTuple):
    """``PowerLimits`` of one plant, and its open-circuit voltage [V]."""

    charge_w: float
    discharge_w: float
    engine_w: float
    engine_least_w: float
    may_be_off: bool
    ocv_v: float


@njit(cache=True, error_model="numpy", forceinline=True)
def bounds_of(
    plant: Plant,
    knots: FloatArray,
    segments: Segments,
    soc: float,
    engine_on: bool,
    time_in_state_s: float,
    engine_power_w: float,
) -> Bounds:
    """``powertrain.power_limits`` of one plant."""
    ocv_v = _at(plant.ocv, knots, segments, soc)
    ohm, per_s = plant.resistance_ohm, plant.charge_c / plant.dt_s
    in_a = _least(_most((plant.soc_max - soc) * per_s, 0.0), plant.charge_max_a)
    out_a = _least(_most((soc - plant.soc_min) * per_s, 0.0), plant.discharge_max_a)
    out_a = _least(out_a, ocv_v / (2.0 * ohm))  # inf where there is no resistance
    charge_w, discharge_w = (ocv_v + ohm * in_a) * in_a, (ocv_v - ohm * out_a) * out_a
    if plant.lossless:
        charge_w = _most((plant.soc_max - soc) * plant.energy_j / plant.dt_s, 0.0)
        discharge_w = _most((soc - plant.soc_min) * plant.energy_j / plant.dt_s, 0.0)
    charge_w = _least(charge_w, plant.battery_max_w)
    discharge_w = _least(discharge_w, plant.battery_max_w)

    waited_s = time_in_state_s + 1e-6  # TIME_ROUNDING_S of the engine
    may_run = engine_on | (waited_s >= plant.min_off_s)
    present_w = _at(plant.crank_of_bus, knots, segments, engine_power_w)
    present_w = present_w if engine_on else 0.0
    least_w = _most(present_w - plant.ramp_w, 0.0)
    most_w = _least(present_w + plant.ramp_w, plant.power_max_w)
    least_w = _at(plant.bus_of_crank, knots, segments, least_w)
    most_w = _at(plant.bus_of_crank, knots, segments, most_w)
    least_w = least_w if may_run else 0.0
    most_w = most_w if may_run else 0.0
    may_be_off = (not engine_on) | (waited_s >= plant.min_on_s)
    return Bounds(charge_w, discharge_w, most_w, least_w, may_be_off, ocv_v)


@njit(cache=True, error_model="numpy", nogil=True)
def limits_of(
    plant: Plant,
    knots: FloatArray,
    segments: Segments,
    soc: FloatArray,
    engine_on: BoolArray,
    time_in_state_s: FloatArray,
    engine_power_w: FloatArray,
    charge_w: FloatArray,
    discharge_w: FloatArray,
    engine_w: FloatArray,
    engine_least_w: FloatArray,
    may_be_off: BoolArray,
    ocv_v: FloatArray,
) -> None:
    """Bounds of n plants into the last six, every array of shape (n,)."""
    for i in range(np.uintp(soc.size)):
        b = bounds_of(
            plant, knots, segments, soc[i], engine_on[i], time_in_state_s[i], engine_power_w[i]
        )
        charge_w[i], discharge_w[i] = b.charge_w, b.discharge_w
        engine_w[i], engine_least_w[i] = b.engine_w, b.engine_least_w
        may_be_off[i], ocv_v[i] = b.may_be_off, b.ocv_v


class Applied(NamedTuple):
    """The next state of one plant and what the step applied but its fuel, in the words of
    ``StepResult``."""

    soc: float
    engine_on: bool
    time_in_state_s: float
    engine_power_w: float
    battery_power_w: float
    started: bool
    shortfall_j: float
    dissipated_j: float
    refused: bool


@njit(cache=True, error_model="numpy", forceinline=True)
def advance(
    plant: Plant,
    b: Bounds,
    soc: float,
    engine_on: bool,
    time_in_state_s: float,
    demand_w: float,
    command_battery_w: float,
    command_engine_w: float,
) -> Applied:
    """``powertrain.step`` of one plant within its bounds, without the fuel."""
    floor_w = 0.0 if b.may_be_off else b.engine_least_w
    lb = _most(-b.charge_w, demand_w - b.engine_w)
    ub = _least(b.discharge_w, demand_w - floor_w)
    wanted_w = demand_w if command_engine_w == 0.0 else command_battery_w
    refused = not math.isfinite(wanted_w)
    wanted_w = 0.0 if refused else wanted_w
    engine_wanted_w = demand_w - _least(_most(wanted_w, lb), _most(lb, ub))

    off = (b.may_be_off & (engine_wanted_w <= plant.rounding_w)) | (b.engine_w <= 0.0)
    running_w = _least(_most(engine_wanted_w, b.engine_least_w), b.engine_w)
    engine_w = 0.0 if off else running_w
    battery_w = _least(_most(demand_w - engine_w, -b.charge_w), b.discharge_w)
    imbalance_w = demand_w - engine_w - battery_w
    imbalance_w = 0.0 if abs(imbalance_w) <= plant.rounding_w else imbalance_w

    started = (not off) & (not engine_on)
    root_v = math.sqrt(_most(b.ocv_v * b.ocv_v - 4.0 * plant.resistance_ohm * battery_w, 0.0))
    spent = 2.0 * battery_w / (b.ocv_v + root_v) * plant.dt_s / plant.charge_c
    if plant.lossless:
        spent = battery_w * plant.dt_s / plant.energy_j
    after = soc - spent
    after = _least(_most(after, _least(plant.soc_min, soc)), _most(plant.soc_max, soc))
    return Applied(
        after,
        not off,
        (time_in_state_s if engine_on != off else 0.0) + plant.dt_s,
        engine_w,
        battery_w,
        started,
        _most(imbalance_w, 0.0) * plant.dt_s,
        _most(-imbalance_w, 0.0) * plant.dt_s,
        refused,
    )


@njit(cache=True, error_model="numpy", forceinline=True)
def fuel_of(
    plant: Plant,
    knots: FloatArray,
    segments: Segments,
    engine_w: float,
    engine_on: bool,
    started: bool,
) -> float:
    """Fuel of one step [kg], start fuel included."""
    crank_w = _at(plant.crank_of_bus, knots, segments, engine_w)
    of_curve = _at(plant.curve, knots, segments, crank_w)
    burning = crank_w / (of_curve * plant.lhv_j_per_kg)
    burning = of_curve if plant.fuel_curve else burning
    fuel_kg = _most(burning, plant.idle_fuel_kg_per_s) * plant.dt_s
    fuel_kg = fuel_kg if engine_on else 0.0
    return fuel_kg + (plant.start_fuel_kg if started else 0.0)


@njit(cache=True, error_model="numpy")
def _step_block(
    plant: Plant,
    knots: FloatArray,
    segments: Segments,
    scratch: FloatArray,
    may_be_off: BoolArray,
    soc: FloatArray,
    engine_on: BoolArray,
    time_in_state_s: FloatArray,
    engine_power_w: FloatArray,
    demand_w: FloatArray,
    command_battery_w: FloatArray,
    command_engine_w: FloatArray,
    battery_power_w: FloatArray,
    applied_engine_w: FloatArray,
    fuel_kg: FloatArray,
    started: BoolArray,
    shortfall_j: FloatArray,
    dissipated_j: FloatArray,
    refused: BoolArray,
) -> None:
    """One step of n <= BLOCK plants. Three loops, because a step is one long chain of results that
    wait for each other: in a short loop the processor works on several plants at a time."""
    charge_w, discharge_w, engine_w, least_w, ocv_v = scratch
    limits_of(
        plant, knots, segments, soc, engine_on, time_in_state_s, engine_power_w, charge_w,
        discharge_w, engine_w, least_w, may_be_off, ocv_v,
    )  # fmt: skip
    for i in range(np.uintp(soc.size)):
        b = Bounds(charge_w[i], discharge_w[i], engine_w[i], least_w[i], may_be_off[i], ocv_v[i])
        r = advance(
            plant,
            b,
            soc[i],
            engine_on[i],
            time_in_state_s[i],
            demand_w[i],
            command_battery_w[i],
            command_engine_w[i],
        )
        soc[i], engine_on[i] = r.soc, r.engine_on
        time_in_state_s[i], engine_power_w[i] = r.time_in_state_s, r.engine_power_w
        battery_power_w[i], applied_engine_w[i] = r.battery_power_w, r.engine_power_w
        started[i], refused[i] = r.started, r.refused
        shortfall_j[i], dissipated_j[i] = r.shortfall_j, r.dissipated_j
    for i in range(np.uintp(soc.size)):
        fuel_kg[i] = fuel_of(plant, knots, segments, engine_power_w[i], engine_on[i], started[i])


@njit(cache=True, error_model="numpy", nogil=True)
def step_range(
    plant: Plant,
    knots: FloatArray,
    segments: Segments,
    begin: int,
    end: int,
    soc: FloatArray,
    engine_on: BoolArray,
    time_in_state_s: FloatArray,
    engine_power_w: FloatArray,
    demand_w: FloatArray,
    command_battery_w: FloatArray,
    command_engine_w: FloatArray,
    battery_power_w: FloatArray,
    applied_engine_w: FloatArray,
    fuel_kg: FloatArray,
    started: BoolArray,
    shortfall_j: FloatArray,
    dissipated_j: FloatArray,
    refused: BoolArray,
) -> None:
    """One step of plants ``begin`` to ``end``; every array has shape (B,). The four state arrays
    are overwritten by the next state, the last seven by what was applied."""
    scratch, may_be_off = np.empty((5, BLOCK)), np.empty(BLOCK, dtype=np.bool_)
    for first in range(begin, end, BLOCK):
        last = min(first + BLOCK, end)
        _step_block(
            plant, knots, segments, scratch, may_be_off, soc[first:last],
            engine_on[first:last], time_in_state_s[first:last], engine_power_w[first:last],
            demand_w[first:last], command_battery_w[first:last], command_engine_w[first:last],
            battery_power_w[first:last], applied_engine_w[first:last], fuel_kg[first:last],
            started[first:last], shortfall_j[first:last], dissipated_j[first:last],
            refused[first:last],
        )  # fmt: skip


@njit(cache=True, error_model="numpy", nogil=True)
def drive_range(
    plant: Plant,
    knots: FloatArray,
    segments: Segments,
    begin: int,
    end: int,
    soc: FloatArray,
    engine_on: BoolArray,
    time_in_state_s: FloatArray,
    engine_power_w: FloatArray,
    demand_w: FloatArray,
    command_battery_w: FloatArray,
    command_engine_w: FloatArray,
    fuel_kg: FloatArray,
    starts: FloatArray,
    shortfall_j: FloatArray,
    dissipated_j: FloatArray,
    refused: FloatArray,
) -> None:
    """T steps of plants ``begin`` to ``end``. Demand and commands are (T, B), state and the sums
    that the last five are raised by (B,)."""
    scratch, may_be_off = np.empty((5, BLOCK)), np.empty(BLOCK, dtype=np.bool_)
    numbers, started, refusals = np.empty((5, BLOCK)), may_be_off.copy(), may_be_off.copy()
    for first in range(begin, end, BLOCK):
        last = min(first + BLOCK, end)
        n = last - first
        for t in range(demand_w.shape[0]):
            _step_block(
                plant, knots, segments, scratch, may_be_off, soc[first:last],
                engine_on[first:last], time_in_state_s[first:last], engine_power_w[first:last],
                demand_w[t, first:last], command_battery_w[t, first:last],
                command_engine_w[t, first:last], numbers[0, :n], numbers[1, :n], numbers[2, :n],
                started[:n], numbers[3, :n], numbers[4, :n], refusals[:n],
            )  # fmt: skip
            for i in range(n):
                fuel_kg[first + i] += numbers[2, i]
                starts[first + i] += started[i]
                shortfall_j[first + i] += numbers[3, i]
                dissipated_j[first + i] += numbers[4, i]
                refused[first + i] += refusals[i]
