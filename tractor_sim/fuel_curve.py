"""From a measured fuel curve to one that is convex over bus power, idle included.

Where marginal fuel falls with power, an optimum jumps between two powers each second, which no
engine does and which a score would then reward. The lower convex hull is the least change that
rules it out.
"""

import numpy as np

from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.generator import GeneratorParams, knots_w, to_bus_w


def convex_fuel_curve(
    generator: GeneratorParams,
    power_w: FloatArray,
    fuel_kg_per_s: FloatArray,
    idle_fuel_kg_per_s: float,
) -> tuple[FloatArray, FloatArray]:
    """Knots (K,) over crankshaft power [W] and fuel [kg/s], convex over bus power.

    Args:
        generator: between crankshaft and bus.
        power_w: (M,), crankshaft powers, increasing; the last is the engine's maximum [W].
        fuel_kg_per_s: (M,), fuel rate while on at these powers.
        idle_fuel_kg_per_s: fuel rate at power 0, where the curve does not begin there.

    Returns:
        The knots of curve and generator together, from 0 W, and the hull's fuel there. Between
        two of them both fuel and bus power are linear over crankshaft power, so fuel is convex
        over bus power everywhere.
    """
    peak_w = float(power_w[-1])
    crank_w, fuel = power_w, fuel_kg_per_s
    if crank_w[0] > 0.0:
        crank_w = np.concatenate(([0.0], crank_w))
        fuel = np.concatenate(([idle_fuel_kg_per_s], fuel))
    # To the milliwatt: two knots that differ by rounding would make a slope of rounding.
    both = np.concatenate((crank_w, knots_w(generator, peak_w)[0]))
    knots: FloatArray = np.unique(np.round(both, 3).astype(np.float64))
    knots[-1] = peak_w
    bus_w, raw = to_bus_w(generator, knots, peak_w), np.interp(knots, crank_w, fuel)
    corners = _lower_hull(bus_w, raw)
    return knots, np.interp(bus_w, bus_w[corners], raw[corners])


def _lower_hull(x: FloatArray, y: FloatArray) -> list[int]:
    """Indices of the lower convex hull of points with increasing x (Andrew's monotone chain)."""
    hull: list[int] = []
    for i in range(len(x)):
        while len(hull) > 1:
            a, b = hull[-2], hull[-1]
            if (y[b] - y[a]) * (x[i] - x[a]) < (y[i] - y[a]) * (x[b] - x[a]):
                break
            hull.pop()
        hull.append(i)
    return hull
