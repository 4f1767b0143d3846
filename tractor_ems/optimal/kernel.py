"""The inner loop of the dynamic programme, compiled.

Knows arrays only: SOC moves, limits and fuel come in as tables, so another battery or engine is
another table, not another kernel.
"""

import numpy as np
from numba import njit

from tractor_msgs_py.trajectory import FloatArray


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def backward(
    values: FloatArray,
    soc_grid: FloatArray,
    power_demand_w: FloatArray,
    power_w: FloatArray,
    soc_move: FloatArray,
    fuel_kg: FloatArray,
    knot_power_w: FloatArray,
    knot_fuel_kg: FloatArray,
    lb_w: FloatArray,
    ub_w: FloatArray,
    end_power_w: FloatArray,
    end_cost_kg: FloatArray,
) -> None:
    """Fill ``values[:-1]`` from ``values[-1]``: V_k(s) = min over u of cost + V_{k+1}(s').

    V_{k+1} is piecewise linear over its row of nodes, goes on with the lowest slope below it and
    stays what it is above. Candidates of node i at step k: every table power and every engine
    knot within [lb, ub], and the M powers that were made for this node.

    Args:
        values: (T + 1, N), row T given [kg].
        soc_grid: (T + 1, N), every row increasing.
        power_demand_w: (T,).
        power_w: (A,), battery powers, increasing.
        soc_move: (A,), SOC change of each power, decreasing.
        fuel_kg: (T, A), fuel of the engine power that a table power leaves at step k.
        knot_power_w, knot_fuel_kg: (K,), engine powers at the bus, increasing, and their fuel.
        lb_w, ub_w: (T, N), feasible battery power; lb > ub rules table and knots out.
        end_power_w, end_cost_kg: (M, T, N), powers made for each node and what they cost in this
            step; inf rules one out. At least one per node is finite.
    """
    steps, nodes = values.shape[0] - 1, values.shape[1]
    slopes = np.zeros(nodes)  # the cell above the last node is flat
    for k in range(steps - 1, -1, -1):
        following, grid, fuel = values[k + 1], soc_grid[k + 1], fuel_kg[k]
        for j in range(nodes - 1):
            slopes[j] = (following[j + 1] - following[j]) / (grid[j + 1] - grid[j])
        for i in range(nodes):
            soc, lb, ub = soc_grid[k, i], lb_w[k, i], ub_w[k, i]
            best = np.inf
            a = np.searchsorted(power_w, lb)
            last = np.searchsorted(power_w, ub, side="right")
            j = _cell(grid, soc + soc_move[a]) if a < last else 0
            while a < last:  # one cell at a time: within a cell only the table is read
                stop = last
                if j > 0 and soc + soc_move[last - 1] < grid[j]:
                    stop = _first_below(soc_move, a, last, grid[j] - soc)
                least, slope = np.inf, slopes[j]
                for b in range(a, stop):
                    cost = fuel[b] + slope * soc_move[b]
                    if cost < least:
                        least = cost
                best = min(best, least + following[j] + slope * (soc - grid[j]))
                a = stop
                j -= 1
            for q in range(len(knot_power_w)):
                wanted_w = power_demand_w[k] - knot_power_w[q]
                if lb <= wanted_w <= ub:
                    after = soc + _move(power_w, soc_move, wanted_w)
                    j = _cell(grid, after)
                    cost = knot_fuel_kg[q] + following[j] + slopes[j] * (after - grid[j])
                    best = min(best, cost)
            for m in range(end_power_w.shape[0]):
                cost = end_cost_kg[m, k, i]
                if cost < np.inf:
                    after = soc + _move(power_w, soc_move, end_power_w[m, k, i])
                    j = _cell(grid, after)
                    best = min(best, cost + following[j] + slopes[j] * (after - grid[j]))
            values[k, i] = best


@njit(cache=True, error_model="numpy")
def _cell(grid: FloatArray, soc: float) -> int:
    """The node at or below ``soc``, 0 for all that is lower: a guess from even spacing between
    the second node and the last but one, and a short walk from there."""
    last = len(grid) - 1
    x = (soc - grid[1]) / (grid[last - 1] - grid[1]) * (last - 2)
    j = int(min(max(x + 1.0, 0.0), float(last)))
    while j > 0 and soc < grid[j]:
        j -= 1
    while j < last and soc >= grid[j + 1]:
        j += 1
    return j


@njit(cache=True, error_model="numpy")
def _first_below(soc_move: FloatArray, begin: int, end: int, threshold: float) -> int:
    """First index from ``begin`` whose move is below the threshold, given that end - 1 is."""
    step, low, high = 1, begin, begin
    while high < end - 1 and soc_move[high] >= threshold:
        low, high, step = high + 1, min(high + step, end - 1), 2 * step
    while low < high:
        middle = (low + high) // 2
        if soc_move[middle] >= threshold:
            low = middle + 1
        else:
            high = middle
    return low


@njit(cache=True, error_model="numpy")
def _move(power_w: FloatArray, soc_move: FloatArray, wanted_w: float) -> float:
    """SOC move of a power between two evenly spaced table powers."""
    step_w = (power_w[-1] - power_w[0]) / (len(power_w) - 1)
    x = (wanted_w - power_w[0]) / step_w
    a = min(max(int(x), 0), len(power_w) - 2)
    move: float = soc_move[a] + (x - a) * (soc_move[a + 1] - soc_move[a])
    return move
