"""The inner loop of the dynamic programme, compiled.

Knows arrays only: next SOC and fuel of every candidate come in as tables, so another battery or
engine is another table, not another kernel.
"""

import numpy as np
from numba import njit

from tractor_msgs_py.trajectory import FloatArray, IntArray

# Not "reassoc": the result must not depend on how the compiler orders a sum.
_FASTMATH = {"nnan", "nsz", "contract"}


@njit(cache=True, error_model="numpy", fastmath=_FASTMATH)
def backward(
    values: FloatArray,
    soc_grid: FloatArray,
    power_w: FloatArray,
    soc_move: FloatArray,
    top_cell: IntArray,
    cell_start: IntArray,
    fuel_kg: FloatArray,
    power_demand_w: FloatArray,
    charge_w: FloatArray,
    discharge_w: FloatArray,
    knot_power_w: FloatArray,
    knot_fuel_kg: FloatArray,
    shortfall_price_kg_per_w: float,
) -> None:
    """Fill ``values[:-1]`` from ``values[-1]``: V_k(s) = min over u of fuel + V_{k+1}(s').

    V_{k+1} is piecewise linear over the grid and goes on with its outermost slopes beyond it.
    Candidates of node i at step k: every table power within [lb, ub] and every engine knot.

    Args:
        values: (T + 1, N), row T given [kg].
        soc_grid: (N,), increasing.
        power_w: (A,), battery powers, increasing; contains -charge_w and discharge_w of every
            node, so that a lb or ub set by the battery is itself a candidate.
        soc_move: (R, A), SOC change of each power, decreasing along a row; R is N, or 1 where
            all nodes share it.
        top_cell: (N,), the cell that power 0 of the table leads to.
        cell_start: (N, C + 1), powers cell_start[i, c] up to cell_start[i, c + 1] lead from
            node i to cell top_cell[i] - c.
        fuel_kg: (T, A), fuel of the engine power that a table power leaves at step k.
        power_demand_w: (T,).
        charge_w, discharge_w: (N,), battery limits, magnitudes.
        knot_power_w, knot_fuel_kg: (K,), engine powers at the bus from 0 (off) to the maximum,
            increasing, and their fuel per step; so a lb or ub set by the engine is a candidate.
        shortfall_price_kg_per_w: price of one watt of unmet demand over one step.
    """
    steps, nodes = values.shape[0] - 1, soc_grid.shape[0]
    knots, cells = knot_power_w.shape[0], cell_start.shape[1] - 1
    engine_max_w, fuel_max_kg = knot_power_w[knots - 1], knot_fuel_kg[knots - 1]
    first = np.searchsorted(power_w, -charge_w)
    last = np.searchsorted(power_w, discharge_w, side="right")
    slopes = np.empty(nodes - 1)
    left = np.empty(knots, dtype=np.int64)
    weight = np.empty(knots)
    for k in range(steps - 1, -1, -1):
        demand_w, fuel, following = power_demand_w[k], fuel_kg[k], values[k + 1]
        for j in range(nodes - 1):
            slopes[j] = (following[j + 1] - following[j]) / (soc_grid[j + 1] - soc_grid[j])
        lowest = np.searchsorted(power_w, demand_w - engine_max_w)
        highest = np.searchsorted(power_w, demand_w, side="right")
        for q in range(knots):
            wanted_w = demand_w - knot_power_w[q]
            a = min(max(np.searchsorted(power_w, wanted_w) - 1, 0), power_w.shape[0] - 2)
            left[q] = a
            weight[q] = (wanted_w - power_w[a]) / (power_w[a + 1] - power_w[a])
        for i in range(nodes):
            soc = soc_grid[i]
            move = soc_move[min(i, soc_move.shape[0] - 1)]
            lb = max(-charge_w[i], demand_w - engine_max_w)
            ub = min(discharge_w[i], demand_w)
            if lb > ub:  # no choice is left: everything for the load, or braking into the battery
                short_w = demand_w - engine_max_w - discharge_w[i]
                a = last[i] - 1 if short_w > 0.0 else first[i]
                after = soc + move[a]
                j = _cell(soc_grid, after, top_cell[i])
                best = following[j] + slopes[j] * (after - soc_grid[j])
                if short_w > 0.0:
                    best += fuel_max_kg + short_w * shortfall_price_kg_per_w
                values[k, i] = best
                continue
            best = np.inf
            begin, end = max(first[i], lowest), min(last[i], highest)
            for c in range(cells):
                start, stop = max(begin, cell_start[i, c]), min(end, cell_start[i, c + 1])
                if start < stop:
                    j = top_cell[i] - c
                    slope = slopes[j]
                    least = np.inf
                    for a in range(start, stop):
                        least = min(least, fuel[a] + slope * move[a])
                    best = min(best, least + following[j] + slope * (soc - soc_grid[j]))
            j = top_cell[i]
            for q in range(knots):
                wanted_w = demand_w - knot_power_w[q]
                if lb <= wanted_w <= ub:
                    a = left[q]
                    after = soc + move[a] + weight[q] * (move[a + 1] - move[a])
                    j = _cell(soc_grid, after, j)
                    cost = following[j] + slopes[j] * (after - soc_grid[j]) + knot_fuel_kg[q]
                    best = min(best, cost)
            values[k, i] = best


@njit(cache=True, error_model="numpy")
def _cell(soc_grid: FloatArray, soc: float, start: int) -> int:
    """The cell of ``soc``, walked to from a cell near it; the outermost ones have no far end."""
    j = start
    while j > 0 and soc < soc_grid[j]:
        j -= 1
    while j < len(soc_grid) - 2 and soc >= soc_grid[j + 1]:
        j += 1
    return j
