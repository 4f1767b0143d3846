"""The pairs of a table, compiled: which were visited, what they are worth, saving and restoring.

Every function goes once through the table and never holds a list of pairs: at the paper's size
there are 61 million.
"""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from tractor_ems.learning.mdp import (
    Mdp,
    advance,
    battery_power_w,
    bounds_w,
    feasible_actions,
    reward_of,
)
from tractor_msgs_py.trajectory import FloatArray, IntArray

Table = NDArray[np.float32]
Bits = NDArray[np.uint8]


class Grid(NamedTuple):
    """How a state finds its row: bins of equal width.

    Attributes:
        soc_bins, demand_bins: how many.
        soc_from, soc_step: lower edge of the first bin, and width.
        demand_from_w, demand_step_w: the same of the demand [W]; width 0: one demand only.
        interpolate: look up between the two nearest SOC bin centres.
    """

    soc_bins: int
    demand_bins: int
    soc_from: float
    soc_step: float
    demand_from_w: float
    demand_step_w: float
    interpolate: bool


@njit(cache=True, error_model="numpy")
def mark(bits: Bits, pair: int) -> None:
    """Set the bit of a (row, action) pair; little-endian within a byte."""
    bits[pair >> 3] |= np.uint8(1 << (pair & 7))


@njit(cache=True, error_model="numpy")
def marked(bits: Bits, pair: int) -> bool:
    """Whether the bit of a pair is set."""
    return bool((bits[pair >> 3] >> (pair & 7)) & 1)


@njit(cache=True, error_model="numpy")
def reward_at_centre(grid: Grid, mdp: Mdp, row: int, action: int) -> float:
    """Reward of an action, clipped to the feasible range, at the centre of its row's bins."""
    soc = grid.soc_from + (row // grid.demand_bins + 0.5) * grid.soc_step
    demand_w = grid.demand_from_w + (row % grid.demand_bins + 0.5) * grid.demand_step_w
    lb, ub = bounds_w(mdp, demand_w, soc)
    wanted_w = battery_power_w(mdp, action, demand_w, lb, ub)
    after, engine_w, fuel_kg = advance(mdp, demand_w, soc, wanted_w)
    return reward_of(mdp, engine_w, fuel_kg, soc, after)


@njit(cache=True, error_model="numpy")
def correlate(
    tables: Table,
    visited: Bits,
    grid: Grid,
    mdp: Mdp,
    ranks: IntArray,
    sample_q: FloatArray,
    sample_reward: FloatArray,
) -> tuple[float, float, float]:
    """Sums of squares of Q and reward and of their product about the means, over visited pairs.

    Q is the mean over the tables. ``ranks``, increasing, says which visited pairs, counted from
    0, go into the samples. Welford's recurrence, so that one pass is enough and no digits go.
    """
    actions, taken, n = tables.shape[2], 0, 0
    mean_q = mean_r = square_q = square_r = product = 0.0
    for pair in range(tables.shape[1] * actions):
        if not marked(visited, pair):
            continue
        row, action = pair // actions, pair % actions
        q = 0.0
        for table in range(len(tables)):
            q += tables[table, row, action]
        q /= len(tables)
        r = reward_at_centre(grid, mdp, row, action)
        if taken < len(ranks) and ranks[taken] == n:
            sample_q[taken], sample_reward[taken] = q, r
            taken += 1
        n += 1
        from_q, from_r = q - mean_q, r - mean_r
        mean_q += from_q / n
        mean_r += from_r / n
        square_q += from_q * (q - mean_q)
        square_r += from_r * (r - mean_r)
        product += from_q * (r - mean_r)
    return square_q, square_r, product


@njit(cache=True, error_model="numpy")
def count_feasible(grid: Grid, mdp: Mdp) -> int:
    """(row, action) pairs that the plant allows at some state whose look-up uses the row.

    Both ends of the range are monotone in SOC and in demand, so the corners decide.
    """
    total = 0
    reach = 1.0 if grid.interpolate else 0.5  # bins on each side of the centre
    for i in range(grid.soc_bins):
        low = max(grid.soc_from + (i + 0.5 - reach) * grid.soc_step, mdp.soc_min)
        high = min(grid.soc_from + (i + 0.5 + reach) * grid.soc_step, mdp.soc_max)
        for j in range(grid.demand_bins):
            first, last = len(mdp.action_power_w), -1
            for soc in (low, high):
                for edge in (j, j + 1):
                    demand_w = grid.demand_from_w + edge * grid.demand_step_w
                    lb, ub = bounds_w(mdp, demand_w, soc)
                    a, b = feasible_actions(mdp, demand_w, lb, ub)
                    first, last = min(first, a), max(last, b)
            total += last - first + 1
    return total


@njit(cache=True, error_model="numpy")
def gather(tables: Table, visited: Bits, out: Table) -> None:
    """Entries of the visited pairs, shape (tables, pairs visited), in the order of the table."""
    actions, n = tables.shape[2], 0
    for pair in range(tables.shape[1] * actions):
        if marked(visited, pair):
            for table in range(len(tables)):
                out[table, n] = tables[table, pair // actions, pair % actions]
            n += 1


@njit(cache=True, error_model="numpy")
def scatter(tables: Table, visited: Bits, values: Table) -> None:
    """Undo ``gather``: write the entries of the visited pairs, and those alone."""
    actions, n = tables.shape[2], 0
    for pair in range(tables.shape[1] * actions):
        if marked(visited, pair):
            for table in range(len(tables)):
                tables[table, pair // actions, pair % actions] = values[table, n]
            n += 1
