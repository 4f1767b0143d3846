"""Generator and rectifier: crankshaft power to bus power and back.

Bus power is piecewise linear over crankshaft power, so a fuel curve that is piecewise linear over
one is so over the other.
"""

from dataclasses import dataclass

import numpy as np

from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.trajectory import FloatArray


@dataclass(frozen=True)
class GeneratorParams:
    """Efficiency at load fractions; a single 1.0 is an ideal generator.

    Attributes:
        load_fraction: knots, increasing from 0 to 1 (crankshaft power over engine maximum).
        curve_efficiency: efficiency at the knots, 0 < value <= 1.
    """

    load_fraction: tuple[float, ...] = (0.0, 1.0)
    curve_efficiency: tuple[float, ...] = (1.0, 1.0)

    def __post_init__(self) -> None:
        load, values = np.array(self.load_fraction), np.array(self.curve_efficiency)
        if len(load) < 2 or len(load) != len(values) or np.any(np.diff(load) <= 0):
            raise ConfigError(
                "generator.load_fraction: at least 2 increasing knots, as many as efficiencies"
            )
        if load[0] != 0.0 or load[-1] != 1.0:
            raise ConfigError(
                f"generator.load_fraction: spans {load[0]}..{load[-1]}, must be 0..1"
            )
        if not np.all((values > 0) & (values <= 1)):
            raise ConfigError("generator.curve_efficiency: every value must lie in 0 < value <= 1")
        if np.any(np.diff(load * values) <= 0):
            raise ConfigError(
                "generator.curve_efficiency: bus power must increase with crankshaft power"
            )

    @property
    def ideal(self) -> bool:
        """True when bus power equals crankshaft power exactly."""
        return all(value == 1.0 for value in self.curve_efficiency)


def knots_w(params: GeneratorParams, engine_power_max_w: float) -> tuple[FloatArray, FloatArray]:
    """Knots as crankshaft power and bus power, both increasing from 0 [W]."""
    crank_w = np.array(params.load_fraction) * engine_power_max_w
    return crank_w, crank_w * np.array(params.curve_efficiency)


def to_bus_w(
    params: GeneratorParams, crank_w: FloatArray, engine_power_max_w: float
) -> FloatArray:
    """Bus power of a crankshaft power [W], any shape."""
    if params.ideal:
        return np.asarray(crank_w, dtype=np.float64)
    crank, bus = knots_w(params, engine_power_max_w)
    return np.interp(crank_w, crank, bus)


def to_crank_w(
    params: GeneratorParams, bus_w: FloatArray, engine_power_max_w: float
) -> FloatArray:
    """Crankshaft power that gives a bus power [W], the inverse of :func:`to_bus_w`."""
    if params.ideal:
        return np.asarray(bus_w, dtype=np.float64)
    crank, bus = knots_w(params, engine_power_max_w)
    return np.interp(bus_w, bus, crank)
