"""The compiled loop that makes a plan fit ramp limit and minimum times: state (engine power, on or
off and for how long), battery energy at a price.

Knows arrays only; ``bracket`` makes them.
"""

import numpy as np
from numba import njit

from tractor_msgs_py.trajectory import BoolArray, FloatArray, IntArray


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def priced_levels(
    cost_on_kg: FloatArray,
    cost_off_kg: FloatArray,
    start_kg: float,
    reach: int,
    steps_on: int,
    steps_off: int,
    levels: IntArray,
) -> float:
    """Fill ``levels`` (T,) with the engine's power level at every step, -1 for off.

    Args:
        cost_on_kg: (T, M), cost of a step at each level, battery energy included.
        cost_off_kg: (T,), cost of a step with the engine off.
        start_kg: cost of a start; the engine is off, and may be started, before the first step.
        reach: levels that one step may change by; a start reaches level ``reach`` at most.
        steps_on, steps_off: least steps in a state, at least 1.

    Returns:
        What it costs [kg].
    """
    steps, count = cost_on_kg.shape
    on, off = np.zeros((steps_on, count)), np.zeros(steps_off)
    on_after, off_after = np.zeros((steps_on, count)), np.zeros(steps_off)
    to_level = np.empty((steps, steps_on, count), dtype=np.int16)
    from_off = np.empty((steps, steps_off), dtype=np.int16)
    through = np.empty(count)
    for k in range(steps - 1, -1, -1):
        on, on_after, off, off_after = on_after, on, off_after, off
        for t in range(steps_on):
            following = on_after[min(t + 1, steps_on - 1)]
            for m in range(count):
                through[m] = cost_on_kg[k, m] + following[m]
            leave = np.inf
            if t == steps_on - 1:
                leave = cost_off_kg[k] + off_after[0]
            for m in range(count):
                best, chosen = leave, -1
                for n in range(max(0, m - reach), min(count, m + reach + 1)):
                    if through[n] < best:
                        best, chosen = through[n], n
                on[t, m], to_level[k, t, m] = best, chosen
        for t in range(steps_off):
            best, chosen = cost_off_kg[k] + off_after[min(t + 1, steps_off - 1)], -1
            if t == steps_off - 1:
                for n in range(min(count, reach + 1)):
                    cost = start_kg + cost_on_kg[k, n] + on_after[0, n]
                    if cost < best:
                        best, chosen = cost, n
            off[t], from_off[k, t] = best, chosen
    level, time = -1, steps_off - 1
    total: float = off[time]
    for k in range(steps):
        if level < 0:
            level = from_off[k, time]
            time = min(time + 1, steps_off - 1) if level < 0 else 0
        else:
            level = to_level[k, time, level]
            time = min(time + 1, steps_on - 1) if level >= 0 else 0
        levels[k] = level
    return total


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def levels_while(
    cost_on_kg: FloatArray, engine_on: BoolArray, reach: int, levels: IntArray
) -> None:
    """As :func:`priced_levels` where on and off are given, (T,)."""
    steps, count = cost_on_kg.shape
    value = np.zeros((steps + 1, count))
    for k in range(steps - 1, -1, -1):
        if not engine_on[k]:
            continue  # a stop may come from any level: nothing is owed to what follows
        for m in range(count):
            best = cost_on_kg[k, m]
            if k + 1 < steps and engine_on[k + 1]:
                least = np.inf
                for n in range(max(0, m - reach), min(count, m + reach + 1)):
                    least = min(least, value[k + 1, n])
                best += least
            value[k, m] = best
    for k in range(steps):
        if not engine_on[k]:
            levels[k] = -1
            continue
        begin, end = 0, reach + 1
        if k > 0 and engine_on[k - 1]:
            begin, end = levels[k - 1] - reach, levels[k - 1] + reach + 1
        begin, end = max(begin, 0), min(end, count)
        levels[k] = begin + np.argmin(value[k, begin:end])
