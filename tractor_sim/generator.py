"""Generator and rectifier: crankshaft power to bus power and back."""

from dataclasses import dataclass

import numpy as np

from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.trajectory import FloatArray


@dataclass(frozen=True)
class GeneratorParams:
    """Efficiency over load fraction, piecewise linear; a single 1.0 is an ideal generator.

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

    @property
    def ideal(self) -> bool:
        """True when bus power equals crankshaft power exactly."""
        return all(value == 1.0 for value in self.curve_efficiency)


_GRID = 4097


def _table(params: GeneratorParams, engine_power_max_w: float) -> tuple[FloatArray, FloatArray]:
    crank = np.linspace(0.0, engine_power_max_w, _GRID)
    eta = np.interp(crank / engine_power_max_w, params.load_fraction, params.curve_efficiency)
    bus = crank * eta
    if np.any(np.diff(bus) <= 0):
        raise ConfigError("generator: bus power does not increase with crankshaft power")
    return crank, bus


def to_bus_w(
    params: GeneratorParams, crank_w: FloatArray, engine_power_max_w: float
) -> FloatArray:
    """Bus power of a crankshaft power [W], any shape."""
    if params.ideal:
        return np.asarray(crank_w, dtype=np.float64)
    crank, bus = _table(params, engine_power_max_w)
    return np.interp(crank_w, crank, bus)


def to_crank_w(
    params: GeneratorParams, bus_w: FloatArray, engine_power_max_w: float
) -> FloatArray:
    """Crankshaft power that gives a bus power [W], the inverse of :func:`to_bus_w`."""
    if params.ideal:
        return np.asarray(bus_w, dtype=np.float64)
    crank, bus = _table(params, engine_power_max_w)
    return np.interp(bus_w, bus, crank)
