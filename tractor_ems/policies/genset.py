"""Engine and generator as one machine, seen from the bus: what power costs there, and where it is
cheapest. For policies; the plant itself steps in ``tractor_sim.powertrain``.
"""

from functools import lru_cache

import numpy as np

from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.engine import fuel_rate_kg_per_s
from tractor_sim.generator import knots_w, to_bus_w, to_crank_w
from tractor_sim.powertrain import PowertrainParams

HOLD_ON_W = 1.0
"""Bus power that keeps a started engine on: asking for exactly none stops it [W]."""


def power_max_w(params: PowertrainParams) -> float:
    """Most the engine can give at the bus [W]."""
    peak_w = params.engine.power_max_w
    return float(to_bus_w(params.generator, np.array(peak_w), peak_w))


def running_fuel_kg_per_s(params: PowertrainParams, bus_w: FloatArray) -> FloatArray:
    """Fuel rate of an engine that is on at a bus power >= 0, idling included, any shape [kg/s]."""
    crank_w = to_crank_w(params.generator, bus_w, params.engine.power_max_w)
    return fuel_rate_kg_per_s(params.engine, crank_w, np.ones(np.shape(bus_w), dtype=bool))


@lru_cache(maxsize=32)
def power_knots_w(params: PowertrainParams) -> FloatArray:
    """Bus powers where the fuel curve or the generator has a knot, increasing from 0, (K,) [W]."""
    engine = params.engine
    crank_w = np.union1d(engine.curve_power_w, knots_w(params.generator, engine.power_max_w)[0])
    bus_w = to_bus_w(params.generator, crank_w, engine.power_max_w)
    bus_w.flags.writeable = False
    return bus_w


@lru_cache(maxsize=32)
def best_power_w(params: PowertrainParams) -> float:
    """Bus power of least fuel per bus energy [W].

    A knot: fuel is piecewise linear over bus power, so fuel per energy has no minimum between
    two. With an ideal generator it is the engine's own best point; losses at high load move it
    below. (An efficiency curve behind a lossy generator is not piecewise linear; the best knot
    is then the best of the knots.)
    """
    bus_w = power_knots_w(params)[1:]
    return float(bus_w[int(np.argmin(running_fuel_kg_per_s(params, bus_w) / bus_w))])
