"""The compiled loops of the dynamic programme over (SOC, engine on).

The model is the plant without ramp limit and minimum times: a start costs its fuel, everything
else is :mod:`tractor_sim.powertrain`. Knows arrays and one named tuple of numbers only.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from tractor_msgs_py.trajectory import BoolArray, FloatArray, IntArray

ROUNDING_W = 1e-6
"""As in the plant: power below this is rounding."""


class Numbers(NamedTuple):
    """Scalars of a powertrain.

    Attributes:
        resistance_ohm: of the pack.
        amps_per_soc: current that moves SOC by 1 in one step [A].
        power_max_w, charge_max_a, discharge_max_a, soc_min, soc_max: battery limits.
        engine_max_w: largest engine power at the bus [W].
        start_kg: fuel of one start.
        missing_kg: price of ending one SOC too low, or of being where the end is out of reach.
        shortfall_kg_per_w: price of unmet demand over one step.
        held_on: whether the plant has a least time on, which can keep an engine idling where
            nothing can take its power. How long it still does is not in the state, so that here
            it may for any time: a lower bound still. Without, the plant stops it there.
    """

    resistance_ohm: float
    amps_per_soc: float
    power_max_w: float
    charge_max_a: float
    discharge_max_a: float
    soc_min: float
    soc_max: float
    engine_max_w: float
    start_kg: float
    missing_kg: float
    shortfall_kg_per_w: float
    held_on: bool


class Model(NamedTuple):
    """What one step needs of a powertrain.

    Attributes:
        numbers: scalars. Functions of the inner loop take these and the arrays apart: arrays in
            a tuple would be reference-counted at every node.
        ocv: (2, K), SOC knots and open-circuit voltage [V].
        fuel_kg: (F,), fuel of one step while on at even powers from 0 to ``engine_max_w``.
        knots_w: (K,), engine powers at the bus where that has a kink, ends left out.
    """

    numbers: Numbers
    ocv: FloatArray
    fuel_kg: FloatArray
    knots_w: FloatArray


class Row(NamedTuple):
    """The nodes of one step, see :class:`Rows`; ``last`` is the index of the last one."""

    base: float
    low: float
    high: float
    last: int
    cell: float


class Rows(NamedTuple):
    """SOC nodes of every step: ``base + i * cell``, cut to ``low`` and ``high``.

    The rows shift with the SOC that the engine's standing still takes, so that a run with the
    engine off goes from node to node and interpolation does not smear it.

    Attributes:
        base: (T + 1,), in low - cell < base <= low.
        low, high: (T + 1,), what a run may pass through.
        nodes: (T + 1,), how many the row has.
        cell: distance of two nodes [SOC].
    """

    base: FloatArray
    low: FloatArray
    high: FloatArray
    nodes: IntArray
    cell: float


@njit(cache=True, error_model="numpy", forceinline=True)
def open_circuit_v(ocv: FloatArray, soc: float) -> float:
    """Open-circuit voltage [V]; a guess from even knots and a short walk find the knot."""
    last = ocv.shape[1] - 2
    j = int((soc - ocv[0, 0]) / (ocv[0, last + 1] - ocv[0, 0]) * (last + 1))
    j = min(max(j, 0), last)
    while j > 0 and soc < ocv[0, j]:
        j -= 1
    while j < last and soc >= ocv[0, j + 1]:
        j += 1
    t = min(max((soc - ocv[0, j]) / (ocv[0, j + 1] - ocv[0, j]), 0.0), 1.0)
    volts: float = ocv[1, j] + t * (ocv[1, j + 1] - ocv[1, j])
    return volts


@njit(cache=True, error_model="numpy", forceinline=True)
def limits_w(numbers: Numbers, soc: float, ocv_v: float) -> tuple[float, float]:
    """Largest charge and discharge power at the terminals, magnitudes [W]."""
    ohm, per_soc = numbers.resistance_ohm, numbers.amps_per_soc
    in_a = min(max((numbers.soc_max - soc) * per_soc, 0.0), numbers.charge_max_a)
    out_a = min(max((soc - numbers.soc_min) * per_soc, 0.0), numbers.discharge_max_a)
    if ohm > 0.0:
        out_a = min(out_a, ocv_v / (2.0 * ohm))
    charge = min((ocv_v + ohm * in_a) * in_a, numbers.power_max_w)
    return charge, min((ocv_v - ohm * out_a) * out_a, numbers.power_max_w)


@njit(cache=True, error_model="numpy", forceinline=True)
def current_a(numbers: Numbers, ocv_v: float, power_w: float) -> float:
    """Current of a terminal power, > 0 discharging [A]."""
    if numbers.resistance_ohm == 0.0:
        return power_w / ocv_v
    root_v = np.sqrt(max(ocv_v * ocv_v - 4.0 * numbers.resistance_ohm * power_w, 0.0))
    amps: float = 2.0 * power_w / (ocv_v + root_v)
    return amps


@njit(cache=True, error_model="numpy", forceinline=True)
def soc_after(numbers: Numbers, soc: float, ocv_v: float, power_w: float) -> float:
    """SOC after one step of a terminal power, within the window."""
    after = soc - current_a(numbers, ocv_v, power_w) / numbers.amps_per_soc
    return min(max(after, min(numbers.soc_min, soc)), max(numbers.soc_max, soc))


@njit(cache=True, error_model="numpy", forceinline=True)
def fuel_at(fuel_kg: FloatArray, engine_max_w: float, engine_w: float) -> float:
    """Fuel of one step of the running engine at a bus power."""
    table = fuel_kg
    x = min(max(engine_w / engine_max_w, 0.0), 1.0) * (len(table) - 1)
    m = min(int(x), len(table) - 2)
    burnt: float = table[m] + (x - m) * (table[m + 1] - table[m])
    return burnt


@njit(cache=True, error_model="numpy", forceinline=True)
def value_at(values: FloatArray, row: Row, soc: float, missing_kg: float) -> float:
    """A row of values at any SOC: linear between nodes, priced below, constant above."""
    base, low, high, last, cell = row
    if soc <= low:
        return values[0] + missing_kg * (low - soc)  # type: ignore[no-any-return]
    if soc >= high:
        return values[last]  # type: ignore[no-any-return]
    x = (soc - base) / cell
    j = min(max(int(x), 0), last - 1)
    t = x - j
    if j == 0 or j == last - 1:
        left, right = max(base + j * cell, low), min(base + (j + 1) * cell, high)
        t = min(max((soc - left) / (right - left), 0.0), 1.0)
    value: float = values[j] + t * (values[j + 1] - values[j])
    return value


@njit(cache=True, error_model="numpy", fastmath={"contract"}, forceinline=True)
def choices(
    numbers: Numbers,
    ocv: FloatArray,
    fuel_kg: FloatArray,
    knots_w: FloatArray,
    row: Row,
    on: FloatArray,
    off: FloatArray,
    soc: float,
    demand_w: float,
    stride: int,
) -> tuple[float, float, float, float]:
    """Least cost to go of running and of standing still in one step, each with its battery power.

    ``on`` and ``off`` are the values of the next step, on the nodes of ``row``. Running costs its
    fuel without a start, and is inf where the plant stops the engine because nothing can take its
    power; standing still is inf where the battery cannot carry the demand. For
    running are tried both ends (engine at its maximum or idling, battery limits), every power that
    lands on a node, where the value needs no interpolation (every ``stride``-th, then all around
    the best so far, an end or one of these), and the fuel curve's kinks within a node of the best.
    """
    ocv_v = open_circuit_v(ocv, soc)
    charge, discharge = limits_w(numbers, soc, ocv_v)
    low_w = max(-charge, demand_w - numbers.engine_max_w)
    high_w = min(discharge, demand_w)
    stopped = demand_w + charge <= ROUNDING_W and not numbers.held_on
    if low_w > high_w:  # no choice: braking into the battery, or everything for the load
        braking = demand_w + charge < 0.0
        power = -charge if braking else discharge
        after = soc_after(numbers, soc, ocv_v, power)
        cost = value_at(on, row, after, numbers.missing_kg)
        if braking:
            still = value_at(off, row, after, numbers.missing_kg)
            return np.inf if stopped else cost + fuel_kg[0], power, still, power
        short_w = demand_w - numbers.engine_max_w - discharge
        cost += fuel_kg[-1] + numbers.shortfall_kg_per_w * short_w
        return cost, power, np.inf, power
    lowest = soc_after(numbers, soc, ocv_v, high_w)
    highest = soc_after(numbers, soc, ocv_v, low_w)
    still = np.inf
    if demand_w <= discharge + ROUNDING_W:
        still = value_at(off, row, lowest, numbers.missing_kg)
    if stopped:
        return np.inf, high_w, still, high_w
    best_w = high_w
    best = fuel_at(fuel_kg, numbers.engine_max_w, demand_w - high_w)
    best += value_at(on, row, lowest, numbers.missing_kg)
    cost = fuel_at(fuel_kg, numbers.engine_max_w, demand_w - low_w)
    cost += value_at(on, row, highest, numbers.missing_kg)
    base, low, high, last, cell = row
    begin = max(1, int(np.ceil((lowest - base) / cell)))
    end = min(last - 1, int(np.floor((highest - base) / cell)))
    found = begin
    if cost < best:
        best, best_w, found = cost, low_w, end
    ohm = numbers.resistance_ohm
    for side in range(2):
        after, value = (low, on[0]) if side == 0 else (high, on[last])
        if lowest < after < highest:
            amps = (soc - after) * numbers.amps_per_soc
            power = (ocv_v - ohm * amps) * amps
            cost = fuel_at(fuel_kg, numbers.engine_max_w, demand_w - power) + value
            if cost < best:
                best, best_w, found = cost, power, begin if side == 0 else end
    per_w, top = (len(fuel_kg) - 1) / numbers.engine_max_w, len(fuel_kg) - 2
    offset_a, per_node_a = (soc - base) * numbers.amps_per_soc, cell * numbers.amps_per_soc
    step = stride
    while begin <= end:
        for j in range(begin, end + 1, step):
            amps = offset_a - j * per_node_a
            power = (ocv_v - ohm * amps) * amps
            x = (demand_w - power) * per_w
            m = min(max(int(x), 0), top)
            cost = fuel_kg[m] + (x - m) * (fuel_kg[m + 1] - fuel_kg[m]) + on[j]
            if cost < best:
                best, best_w, found = cost, power, j
        if step == 1:
            break
        begin, end, step = max(begin, found - stride + 1), min(end, found + stride - 1), 1
    reach_w, centre_w = ocv_v * per_node_a, best_w
    for knot_w in knots_w:
        power = demand_w - knot_w
        if low_w < power < high_w and abs(power - centre_w) < reach_w:
            after = soc_after(numbers, soc, ocv_v, power)
            cost = fuel_at(fuel_kg, numbers.engine_max_w, knot_w)
            cost += value_at(on, row, after, numbers.missing_kg)
            if cost < best:
                best, best_w = cost, power
    return best, best_w, still, high_w


@njit(cache=True, error_model="numpy", forceinline=True)
def row_of(rows: Rows, k: int) -> Row:
    """The nodes of step k."""
    return Row(rows.base[k], rows.low[k], rows.high[k], rows.nodes[k] - 1, rows.cell)


@njit(cache=True, error_model="numpy")
def backward(
    value_on: FloatArray,
    value_off: FloatArray,
    rows: Rows,
    demand_w: FloatArray,
    model: Model,
    stride: int,
) -> None:
    """Fill rows 0..T-1 of both values from row T.

    V_on = min(run, stand) and V_off = min(run + start, stand), where running goes on with V_on
    and standing still with V_off.
    """
    numbers, ocv, fuel_kg, knots_w = model
    for k in range(len(demand_w) - 1, -1, -1):
        last, row = rows.nodes[k] - 1, row_of(rows, k + 1)
        on, off, power_w = value_on[k + 1], value_off[k + 1], demand_w[k]
        for i in range(last + 1):
            soc = rows.base[k] + i * rows.cell
            if i == 0 or i == last:
                soc = rows.low[k] if i == 0 else rows.high[k]
            run, _, stand, _ = choices(
                numbers, ocv, fuel_kg, knots_w, row, on, off, soc, power_w, stride
            )
            value_on[k, i] = min(run, stand)
            value_off[k, i] = min(run + numbers.start_kg, stand)


@njit(cache=True, error_model="numpy")
def forward(
    value_on: FloatArray,
    value_off: FloatArray,
    rows: Rows,
    demand_w: FloatArray,
    model: Model,
    soc: FloatArray,
    battery_w: FloatArray,
    engine_on: BoolArray,
) -> float:
    """The run that the values lead to, from ``soc[0]``: fills ``soc`` (T + 1,), ``battery_w`` and
    ``engine_on`` (T,); returns what shortfall and its end cost [kg], fuel aside."""
    numbers, ocv, fuel_kg, knots_w = model
    running, unmet_kg = False, 0.0
    for k in range(len(demand_w)):
        on, off, row = value_on[k + 1], value_off[k + 1], row_of(rows, k + 1)
        run, run_w, stand, stand_w = choices(
            numbers, ocv, fuel_kg, knots_w, row, on, off, soc[k], demand_w[k], 1
        )
        running = run + (0.0 if running else numbers.start_kg) < stand
        battery_w[k] = run_w if running else stand_w
        if running:
            short_w = max(demand_w[k] - run_w - numbers.engine_max_w, 0.0)
            unmet_kg += numbers.shortfall_kg_per_w * short_w
        engine_on[k] = running
        soc[k + 1] = soc_after(numbers, soc[k], open_circuit_v(ocv, soc[k]), battery_w[k])
    last = value_on[-1] if running else value_off[-1]
    return unmet_kg + value_at(last, row_of(rows, len(demand_w)), soc[-1], numbers.missing_kg)


@njit(cache=True, error_model="numpy")
def co_states(
    value_on: FloatArray,
    value_off: FloatArray,
    rows: Rows,
    model: Model,
    soc: FloatArray,
    engine_on: BoolArray,
    reach: float,
    co_state: FloatArray,
) -> None:
    """Fill ``co_state`` (T,) with -dV_k/dSOC along a run [kg]: the secant over ``reach`` on either
    side as far as the row goes, because the slope of one cell carries the ripple of starts.

    Where the run is at an end of its row (the last coast to the target, a full battery) V has a
    kink there and the co-state is the one that the run came with.
    """
    edge = 1e-3 * rows.cell
    co_state[:] = np.nan
    for k in range(len(co_state)):
        row = row_of(rows, k)
        values = value_on[k] if k > 0 and engine_on[k - 1] else value_off[k]
        low, high = max(row.low, soc[k] - reach), min(row.high, soc[k] + reach)
        if low < soc[k] - edge and soc[k] + edge < high:
            left = value_at(values, row, low, model.numbers.missing_kg)
            right = value_at(values, row, high, model.numbers.missing_kg)
            co_state[k] = (left - right) / (high - low)
        elif k > 0:
            co_state[k] = co_state[k - 1]
    for k in range(len(co_state) - 2, -1, -1):  # the first steps, where there is no choice yet
        if np.isnan(co_state[k]):
            co_state[k] = co_state[k + 1]
    if np.isnan(co_state[-1]):  # there never was a choice
        co_state[:] = 0.0
