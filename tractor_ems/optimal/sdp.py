"""Stochastic dynamic programming on a Markov chain of demand situations, counted in recordings.

A situation is a cell of a grid over features of demand known by then. State: (situation, SOC,
engine on). The engine is relaxed as in the optimum that scores it: a start costs its fuel, ramp
limit and minimum times are left to the plant.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

from tractor_ems.optimal.one_step_kernel import (
    Cell,
    best_power_w,
    fuel_at,
    parabola,
    soc_change,
)
from tractor_ems.policies.genset import HOLD_ON_W
from tractor_ems.policies.one_step import ALONE_SHARE, BESIDE_SHARE
from tractor_msgs_py.trajectory import FloatArray, IntArray

SEARCH_EVERY = 25
"""Sweeps that reuse the engine powers found by a search."""


class Chain(NamedTuple):
    """Demand situations and how often one follows another.

    Attributes:
        edges: inner edges of every feature, in the feature's unit.
        number: (cells,), situation of a grid cell; an unseen cell has the nearest seen one's.
        demand_w: (Z,), mean demand of a situation [W].
        first: (Z + 1,), where the successors of a situation begin in the next two.
        follower: (N,), situations; share: (N,), their probabilities.
    """

    edges: tuple[FloatArray, ...]
    number: IntArray
    demand_w: FloatArray
    first: IntArray
    follower: IntArray
    share: FloatArray


def cell_of(edges: Sequence[FloatArray], features: FloatArray) -> IntArray:
    """Grid cell of every row of (T, F) features."""
    cell = np.zeros(len(features), dtype=np.int64)
    for column, inner in enumerate(edges):
        cell = cell * (len(inner) + 1) + np.searchsorted(inner, features[:, column])
    return cell


def fit_chain(
    edges: Sequence[FloatArray], traces: Sequence[FloatArray], *, demand_column: int = 0
) -> Chain:
    """Count successors in (T, F) traces of features; the first column is demand [W]."""
    sizes = [len(inner) + 1 for inner in edges]
    cells = [cell_of(edges, trace) for trace in traces]
    joined = np.concatenate(cells)
    seen, index = np.unique(joined, return_inverse=True)
    demand = np.concatenate([trace[:, demand_column] for trace in traces])
    demand_w = np.bincount(index, demand) / np.bincount(index)
    places = np.stack(np.unravel_index(np.arange(int(np.prod(sizes))), sizes), axis=1)
    known = places[seen]
    number = np.empty(len(places), dtype=np.int64)
    for i, place in enumerate(places):  # nearest seen cell, the first feature counts most
        weight = np.array([4.0, *([1.0] * (len(sizes) - 1))])
        number[i] = int(np.argmin(np.sum(weight * (known - place) ** 2, axis=1)))
    z = [number[c] for c in cells]
    now = np.concatenate([s[:-1] for s in z])
    then = np.concatenate([s[1:] for s in z])
    pairs, count = np.unique(now * len(seen) + then, return_counts=True)
    source, follower = np.divmod(pairs, len(seen))
    total = np.bincount(source, count, len(seen))
    share = count / total[source]
    missing = np.flatnonzero(total == 0)  # the last tick of a trace only: it stays where it is
    source = np.append(source, missing)
    follower = np.append(follower, missing)
    share = np.append(share, np.ones(len(missing)))
    order = np.argsort(source, kind="stable")
    first = np.searchsorted(source[order], np.arange(len(seen) + 1))
    return Chain(
        tuple(edges), number, demand_w, first.astype(np.int64),
        follower[order].astype(np.int64), np.ascontiguousarray(share[order]),
    )  # fmt: skip


def running_kg(
    cell: Cell, fuel_kg: FloatArray, engine_max_w: float, ocv_v: float, limit_w: float,
    demand_w: FloatArray, price_kg: float,
) -> FloatArray:  # fmt: skip
    """Least fuel and price of battery energy of a running engine at every demand [kg]: taken off
    the values, so that they stay small."""
    found = np.empty(len(demand_w))
    _running(cell, fuel_kg, engine_max_w, ocv_v, limit_w, demand_w, price_kg, found)
    return found


@njit(cache=True, error_model="numpy")
def _running(
    cell: Cell, fuel_kg: FloatArray, engine_max_w: float, ocv_v: float, limit_w: float,
    demand_w: FloatArray, price_kg: float, found: FloatArray,
) -> None:  # fmt: skip
    for i in range(len(demand_w)):
        d = demand_w[i]
        least, most = _range_w(engine_max_w, limit_w, d)
        low_w, high_w = d - most, d - least
        y0 = -price_kg * soc_change(cell, ocv_v, low_w)
        y1 = -price_kg * soc_change(cell, ocv_v, 0.5 * (low_w + high_w))
        y2 = -price_kg * soc_change(cell, ocv_v, high_w)
        c0, c1, c2 = parabola(low_w, high_w, cell.unit_w, y0, y1, y2)
        _, found[i] = best_power_w(fuel_kg, engine_max_w, d, least, most, cell.unit_w, c0, c1, c2)


@njit(cache=True, error_model="numpy", forceinline=True)
def _range_w(engine_max_w: float, limit_w: float, d: float) -> tuple[float, float]:
    """Least and most bus power of a running engine that ramps at once [W]."""
    most = max(min(engine_max_w, d + limit_w), HOLD_ON_W)
    return min(max(d - BESIDE_SHARE * limit_w, HOLD_ON_W), most), most


@njit(cache=True, error_model="numpy")
def solve_chain(
    cell: Cell, fuel_kg: FloatArray, engine_max_w: float, ocv_v: FloatArray, limit_w: float,
    demand_w: FloatArray, first: IntArray, follower: IntArray, share: FloatArray,
    offset: FloatArray, price_kg: float, holding_kg: FloatArray, start_kg: float, gamma: float,
    sweeps: int, baseline_kg: FloatArray, value: FloatArray,
) -> tuple[float, float]:  # fmt: skip
    """Improve ``value`` (Z, S, 2) by ``sweeps`` of value iteration; returns the last change and
    the constant that each sweep takes off ``value`` [kg]; ``baseline_kg`` (Z,) is taken off too.

    ``price_kg``: of one unit of SOC; ``holding_kg``: (S,), of being at a SOC for one step.
    ``value`` is of post-decision states.
    """
    zs, socs = len(demand_w), len(offset)
    before = np.zeros((zs, socs, 2))
    power = np.zeros((zs, socs))
    width = offset[1] - offset[0]
    moved = level = 0.0
    for sweep in range(sweeps):
        search = sweep % SEARCH_EVERY == 0
        for z in range(zs):
            d = demand_w[z]
            least, most = _range_w(engine_max_w, limit_w, d)
            forced = d > ALONE_SHARE * limit_w
            for s in range(socs):
                v, held = ocv_v[s], holding_kg[s] - baseline_kg[z]
                if search:
                    low_w, high_w = d - most, d - least
                    y = np.empty(3)
                    for i in range(3):
                        c = soc_change(cell, v, low_w + 0.5 * i * (high_w - low_w))
                        y[i] = _after(value, z, 1, s, c, width, gamma, price_kg)
                    c0, c1, c2 = parabola(low_w, high_w, cell.unit_w, y[0], y[1], y[2])
                    power[z, s], _ = best_power_w(
                        fuel_kg, engine_max_w, d, least, most, cell.unit_w, c0, c1, c2
                    )
                c = soc_change(cell, v, d - power[z, s])
                run = fuel_at(fuel_kg, engine_max_w, power[z, s])
                run += _after(value, z, 1, s, c, width, gamma, price_kg)
                still = np.inf
                if not forced:
                    c = soc_change(cell, v, max(d, -limit_w))
                    still = _after(value, z, 0, s, c, width, gamma, price_kg)
                before[z, s, 1] = min(run, still) + held
                before[z, s, 0] = min(run + start_kg, still) + held
        level = before[0, socs // 2, 1]
        moved = 0.0
        for z in range(zs):
            for s in range(socs):
                on = off = 0.0
                for n in range(first[z], first[z + 1]):
                    on += share[n] * before[follower[n], s, 1]
                    off += share[n] * before[follower[n], s, 0]
                moved = max(moved, abs(on - level - value[z, s, 1]))
                value[z, s, 1], value[z, s, 0] = on - level, off - level
    return moved, level


@njit(cache=True, error_model="numpy", forceinline=True)
def _after(
    value: FloatArray, z: int, on: int, s: int, change: float, width: float,
    gamma: float, price_kg: float,
) -> float:  # fmt: skip
    x = change / width
    j = s + int(math_floor(x))
    j = min(max(j, 0), value.shape[1] - 2)
    t = s + x - j
    left, right = value[z, j, on], value[z, j + 1, on]
    cost: float = gamma * (left + t * (right - left)) - price_kg * change
    return cost


@njit(cache=True, error_model="numpy", forceinline=True)
def math_floor(x: float) -> int:
    """Largest whole number <= x."""
    k = int(x)
    return k - 1 if x < k else k
