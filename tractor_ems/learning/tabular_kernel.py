"""Tabular Q-learning and double Q-learning, compiled: look-up, choice, update and episode.

Arrays and numbers only; ``learning.tabular`` holds them and is what others call. ``td_update``
knows no plant, so tests run the same update on decision processes whose Q* is known.

numba's cache looks at a function's own file only: after a change of ``mdp`` or ``tabular_pairs``
touch this file too, or what is compiled here still holds the old ones.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from tractor_ems.learning.mdp import (
    Mdp,
    advance,
    battery_power_w,
    bounds_w,
    feasible_actions,
    reward_of,
)
from tractor_ems.learning.tabular_pairs import Bits, Grid, Table, mark
from tractor_msgs_py.trajectory import FloatArray, IntArray

_BLOCK = 64  # entries compared at once in a search: a few vector registers


class Place(NamedTuple):
    """Where a state is in the table: two rows and the share of the second.

    Without interpolation, and beyond the outermost centres, both rows are one and the share is 0.
    """

    low: int
    high: int
    share: float


@njit(cache=True, error_model="numpy")
def soc_bin(grid: Grid, soc: float) -> int:
    """Bin of a SOC; one outside the window belongs to the bin at that end."""
    return min(max(int((soc - grid.soc_from) / grid.soc_step), 0), grid.soc_bins - 1)


@njit(cache=True, error_model="numpy")
def demand_bin(grid: Grid, demand_w: float) -> int:
    """Bin of a demand; one outside the cycle's range belongs to the bin at that end."""
    if grid.demand_step_w <= 0.0:
        return 0
    index = int((demand_w - grid.demand_from_w) / grid.demand_step_w)
    return min(max(index, 0), grid.demand_bins - 1)


@njit(cache=True, error_model="numpy")
def place_of(grid: Grid, soc: float, column: int) -> Place:
    """Rows of a state, ``column`` being its demand bin. Row = SOC bin * demand bins + column."""
    if not grid.interpolate:
        row = soc_bin(grid, soc) * grid.demand_bins + column
        return Place(row, row, 0.0)
    x = (soc - grid.soc_from) / grid.soc_step - 0.5
    x = min(max(x, 0.0), grid.soc_bins - 1.0)
    below = min(int(x), max(grid.soc_bins - 2, 0))
    low = below * grid.demand_bins + column
    if x == below:
        return Place(low, low, 0.0)
    return Place(low, low + grid.demand_bins, x - below)


@njit(cache=True, error_model="numpy")
def value_of(table: Table, place: Place, action: int) -> float:
    """Q of one action."""
    low = float(table[place.low, action])
    return low + place.share * (float(table[place.high, action]) - low)


@njit(cache=True, error_model="numpy")
def read_row(
    tables: Table, begin: int, end: int, place: Place, first: int, last: int, scratch: Table
) -> Table:
    """Sum of tables begin..end-1 over actions first..last, shape (last - first + 1,).

    The table itself where nothing has to be computed, else the beginning of ``scratch``.
    """
    low = tables[begin, place.low, first : last + 1]
    if place.share == 0.0 and end - begin == 1:
        return low
    out = scratch[: last - first + 1]
    if place.share == 0.0:
        other = tables[end - 1, place.low, first : last + 1]
        for a in range(len(out)):
            out[a] = low[a] + other[a]
        return out
    share = np.float32(place.share)
    high = tables[begin, place.high, first : last + 1]
    for a in range(len(out)):
        out[a] = low[a] + share * (high[a] - low[a])
    if end - begin == 2:
        low = tables[end - 1, place.low, first : last + 1]
        high = tables[end - 1, place.high, first : last + 1]
        for a in range(len(out)):
            out[a] += low[a] + share * (high[a] - low[a])
    return out


@njit(cache=True, error_model="numpy")
def largest(row: Table) -> float:
    """Maximum of a row without NaN.

    Compared as integers that are ordered like the floats they stand for: the compiler does not
    vectorise a maximum of floats, because of NaN and the sign of zero, and is 20 times slower.
    """
    keys = row.view(np.int32)
    best = np.int32(-(2**31))
    for a in range(len(keys)):
        key = keys[a]
        key = np.int32(key ^ np.int32(np.int32(key >> np.int32(31)) & np.int32(0x7FFFFFFF)))
        best = key if key > best else best
    best = np.int32(best ^ np.int32(np.int32(best >> np.int32(31)) & np.int32(0x7FFFFFFF)))
    return float(best.view(np.float32))


@njit(cache=True, error_model="numpy")
def _find(row: Table, wanted: float) -> int:
    """First index of that very value, -1 where there is none."""
    sought = np.float32(wanted)
    begin = 0
    while begin + _BLOCK <= len(row):
        block = row[begin : begin + _BLOCK]
        hits = np.int32(0)
        for j in range(_BLOCK):
            hits += np.int32(1) if block[j] == sought else np.int32(0)
        if hits > 0:
            break
        begin += _BLOCK
    for j in range(begin, len(row)):
        if row[j] == sought:
            return j
    return -1


@njit(cache=True, error_model="numpy")
def best_action(
    tables: Table,
    begin: int,
    end: int,
    place: Place,
    first: int,
    last: int,
    scratch: Table,
    rng: np.random.Generator,
) -> int:
    """Feasible action of the largest sum of tables begin..end-1.

    Most rows hold many entries that were never updated and are all 0. Of equals the first one
    from a random place on, around the end, is taken: no index is preferred for being low.
    """
    row = read_row(tables, begin, end, place, first, last, scratch)
    best = largest(row)
    start = int(rng.integers(0, len(row)))
    found = _find(row[start:], best)
    return first + (start + found if found >= 0 else _find(row[:start], best))


@njit(cache=True, error_model="numpy")
def td_update(
    tables: Table,
    here: Place,
    action: int,
    reward: float,
    following: Place,
    first: int,
    last: int,
    gamma: float,
    alpha: float,
    scratch: Table,
    rng: np.random.Generator,
) -> None:
    """One update from one transition; one table is Q-learning, two are double Q-learning.

        Q_A(s, a) <- Q_A(s, a) + alpha (y - Q_A(s, a))
        y = r + gamma max_a' Q_A(s', a')                 one table
        y = r + gamma Q_B(s', argmax_a' Q_A(s', a'))     two, A and B swapped by a fair coin

    Args:
        tables: shape (1 or 2, rows, A).
        first, last: feasible actions at s', inclusive; a' is one of them.
        scratch: shape (A,).
    """
    chooser = 0
    if len(tables) == 1:
        value = largest(read_row(tables, 0, 1, following, first, last, scratch))
    else:
        chooser = 1 if rng.random() < 0.5 else 0
        best = best_action(tables, chooser, chooser + 1, following, first, last, scratch, rng)
        value = value_of(tables[1 - chooser], following, best)
    table = tables[chooser]
    step = alpha * (reward + gamma * value - value_of(table, here, action))
    table[here.low, action] += (1.0 - here.share) * step
    if here.share > 0.0:
        table[here.high, action] += here.share * step


@njit(cache=True, error_model="numpy")
def train(
    tables: Table,
    visited: Bits,
    state_visits: IntArray,
    grid: Grid,
    mdp: Mdp,
    epsilon: FloatArray,
    gamma: float,
    alpha: float,
    rng: np.random.Generator,
    train_return: FloatArray,
) -> None:
    """Drive and learn, one episode per entry of ``epsilon``, each from ``mdp.soc_initial``.

    The end of the cycle is a truncation: its last step has no successor and is not learnt from.
    """
    steps, actions, count = len(mdp.power_demand_w), tables.shape[2], len(tables)
    scratch = np.empty(actions, dtype=np.float32)
    columns = np.empty(steps, dtype=np.int64)
    for k in range(steps):
        columns[k] = demand_bin(grid, mdp.power_demand_w[k])
    for episode in range(len(epsilon)):
        soc, total = mdp.soc_initial, 0.0
        demand_w = mdp.power_demand_w[0]
        lb, ub = bounds_w(mdp, demand_w, soc)
        first, last = feasible_actions(mdp, demand_w, lb, ub)
        here = place_of(grid, soc, columns[0])
        for k in range(steps):
            state_visits[soc_bin(grid, soc), columns[k]] += 1
            if rng.random() < epsilon[episode]:
                action = int(rng.integers(first, last + 1))
            else:
                action = best_action(tables, 0, count, here, first, last, scratch, rng)
            wanted_w = battery_power_w(mdp, action, demand_w, lb, ub)
            after, engine_w, fuel_kg = advance(mdp, demand_w, soc, wanted_w)
            reward = reward_of(mdp, engine_w, fuel_kg, soc, after)
            total += reward
            if k + 1 == steps:
                break
            demand_w = mdp.power_demand_w[k + 1]
            lb, ub = bounds_w(mdp, demand_w, after)
            first, last = feasible_actions(mdp, demand_w, lb, ub)
            following = place_of(grid, after, columns[k + 1])
            td_update(
                tables, here, action, reward, following, first, last, gamma, alpha, scratch, rng
            )
            mark(visited, here.low * actions + action)
            mark(visited, here.high * actions + action)
            soc, here = after, following
        train_return[episode] = total


@njit(cache=True, error_model="numpy")
def greedy(
    tables: Table,
    grid: Grid,
    mdp: Mdp,
    rng: np.random.Generator,
    asked_w: FloatArray,
    soc: FloatArray,
    engine_w: FloatArray,
    fuel_kg: FloatArray,
    rewards: FloatArray,
) -> None:
    """Drive one episode without exploration or learning; fills (T,) arrays, and ``soc`` (T+1,)."""
    scratch = np.empty(tables.shape[2], dtype=np.float32)
    soc[0] = mdp.soc_initial
    for k in range(len(mdp.power_demand_w)):
        demand_w = mdp.power_demand_w[k]
        lb, ub = bounds_w(mdp, demand_w, soc[k])
        first, last = feasible_actions(mdp, demand_w, lb, ub)
        here = place_of(grid, soc[k], demand_bin(grid, demand_w))
        action = best_action(tables, 0, len(tables), here, first, last, scratch, rng)
        asked_w[k] = battery_power_w(mdp, action, demand_w, lb, ub)
        soc[k + 1], engine_w[k], fuel_kg[k] = advance(mdp, demand_w, soc[k], asked_w[k])
        rewards[k] = reward_of(mdp, engine_w[k], fuel_kg[k], soc[k], soc[k + 1])
