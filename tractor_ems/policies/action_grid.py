"""Which actions of the fixed battery-power grid are feasible: two integers, not a mask.

Every action is projected on [lb, ub]. Actions below lb all mean lb and those above ub all mean
ub, so the distinct actions are a contiguous range of indices whose ends are lb and ub
themselves. "Engine off" (ub = P_dem) is the last of them, a state-dependent index.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tractor_msgs_py.trajectory import BoolArray, FloatArray, IntArray

EDGE_W = 1e-3
"""Powers this close to lb or ub are lb or ub: a wire's rounding, not another action."""


def feasible_range(
    grid_w: FloatArray, lb: FloatArray, ub: FloatArray
) -> tuple[IntArray, IntArray]:
    """First and last feasible index, inclusive, each of the shape of ``lb``.

    ``grid_w[first]`` projects to lb and ``grid_w[last]`` to ub, or to the grid's end where the
    grid does not reach that far. Where lb > ub there is no choice: both indices mean lb.
    """
    first = np.searchsorted(grid_w, lb, side="right") - 1
    last = np.searchsorted(grid_w, np.maximum(lb, ub), side="left")
    top = len(grid_w) - 1
    first = np.clip(first, 0, top).astype(np.int64)
    last = np.clip(last, 0, top).astype(np.int64)
    return first, np.maximum(first, last)


def applied_index(
    grid_w: FloatArray,
    battery_power_w: FloatArray,
    engine_on: BoolArray,
    lb: FloatArray,
    ub: FloatArray,
) -> IntArray:
    """Grid index of a power that was applied; arguments of one shape.

    The nearest grid point, except that lb and ub are the ends of the feasible range, engine off
    is its last index, and a running engine is never that index while it could have been off.
    """
    first, last = feasible_range(grid_w, lb, ub)
    spacing_w = (grid_w[-1] - grid_w[0]) / (len(grid_w) - 1)
    nearest = np.rint((battery_power_w - grid_w[0]) / spacing_w).astype(np.int64)
    at_top = ~engine_on | (battery_power_w >= ub - EDGE_W)
    inner = np.clip(nearest, first, np.maximum(first, last - 1))
    chosen = np.where(at_top, last, inner)
    return np.where((battery_power_w <= lb + EDGE_W) & engine_on, first, chosen)


def in_range(
    first: NDArray[np.integer[Any]], last: NDArray[np.integer[Any]], actions: int
) -> BoolArray:
    """The range as a mask of shape (B, actions); the narrower the integers, the faster."""
    index = np.arange(actions, dtype=first.dtype)
    return (index >= first[:, None]) & (index <= last[:, None])
