"""Curves of one vehicle, sampled: what ``check`` judges and ``plots`` draws.

Data as written in the file beside what is driven; no opinion about either.
"""

from dataclasses import dataclass

import numpy as np

from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.battery import BatteryParams, open_circuit_v, power_limits_w
from tractor_sim.config import load_powertrain, read_powertrain
from tractor_sim.engine import fuel_rate_kg_per_s
from tractor_sim.fuel_curve import convex_fuel_curve
from tractor_sim.generator import to_bus_w
from tractor_sim.powertrain import PowertrainParams

J_PER_KWH = 3.6e6
SAMPLES = 400


@dataclass(frozen=True)
class Vehicle:
    """A vehicle as driven, and its fuel data as written.

    Attributes:
        params: what is driven.
        data_power_w, data_fuel_kg_per_s: the file's fuel curve from 0 W on, shape (M,), over
            crankshaft power; with an efficiency curve the fuel that this means, finely sampled.
        from_efficiency: the file gives an efficiency curve, which is driven as it is.
    """

    params: PowertrainParams
    data_power_w: FloatArray
    data_fuel_kg_per_s: FloatArray
    from_efficiency: bool


@dataclass(frozen=True)
class FuelCurves:
    """Fuel while on over one grid of power, every array of shape (K,).

    Attributes:
        crank_w, bus_w: power at the crankshaft and what the generator makes of it [W].
        data_kg_per_s: as written in the file.
        hull_kg_per_s: its lower convex hull over bus power.
    """

    crank_w: FloatArray
    bus_w: FloatArray
    data_kg_per_s: FloatArray
    hull_kg_per_s: FloatArray

    @property
    def departure(self) -> FloatArray:
        """How far the hull lies below the data, as a fraction of the data, shape (K,)."""
        above = np.where(self.data_kg_per_s > 0.0, self.data_kg_per_s, 1.0)
        part: FloatArray = np.maximum(self.data_kg_per_s - self.hull_kg_per_s, 0.0) / above
        return part


def load_vehicle(name_or_path: str) -> Vehicle:
    """A vehicle by the names that ``load_powertrain`` takes.

    Raises:
        ConfigError: it cannot be read, or a value is out of range.
    """
    params = load_powertrain(name_or_path)
    engine = params.engine
    on = np.ones(SAMPLES + len(engine.curve_power_w), dtype=bool)
    if not engine.curve_fuel_kg_per_s:
        grid_w = np.linspace(0.0, engine.power_max_w, SAMPLES)
        power_w = np.sort(np.concatenate((grid_w, engine.curve_power_w)))
        power_w = np.unique(power_w)
        fuel = fuel_rate_kg_per_s(engine, power_w, on[: len(power_w)])
        return Vehicle(params, power_w, fuel, True)
    written = read_powertrain(name_or_path)[1]["engine"]
    curve = written["curves"][written["curve"]]
    power_w = np.array([float(value) for value in curve["power_w"]])
    fuel = np.array([float(value) for value in curve["fuel_kg_per_s"]])
    if power_w[0] > 0.0:
        power_w = np.concatenate(([0.0], power_w))
        fuel = np.concatenate(([engine.idle_fuel_kg_per_s], fuel))
    return Vehicle(params, power_w, fuel, False)


def fuel_curves(vehicle: Vehicle) -> FuelCurves:
    """Data and hull at the knots of both and on a grid between them."""
    engine, generator = vehicle.params.engine, vehicle.params.generator
    knots_w, hull = convex_fuel_curve(
        generator, vehicle.data_power_w, vehicle.data_fuel_kg_per_s, engine.idle_fuel_kg_per_s
    )
    grid_w = np.linspace(0.0, engine.power_max_w, SAMPLES)
    crank_w = np.unique(np.concatenate((grid_w, knots_w, vehicle.data_power_w)))
    return FuelCurves(
        crank_w=crank_w,
        bus_w=to_bus_w(generator, crank_w, engine.power_max_w),
        data_kg_per_s=np.interp(crank_w, vehicle.data_power_w, vehicle.data_fuel_kg_per_s),
        hull_kg_per_s=np.interp(crank_w, knots_w, hull),
    )


def efficiency_of(
    power_w: FloatArray, fuel_kg_per_s: FloatArray, lhv_j_per_kg: float
) -> FloatArray:
    """Power over fuel power, 0 where nothing burns, shape as given."""
    burning = np.where(fuel_kg_per_s > 0.0, fuel_kg_per_s * lhv_j_per_kg, 1.0)
    eta: FloatArray = np.where(fuel_kg_per_s > 0.0, power_w / burning, 0.0)
    return eta


def bsfc_g_per_kwh(power_w: FloatArray, fuel_kg_per_s: FloatArray) -> FloatArray:
    """Brake specific fuel consumption [g/kWh]; not finite at power 0, shape as given."""
    with np.errstate(divide="ignore", invalid="ignore"):
        bsfc: FloatArray = fuel_kg_per_s * 1e3 * J_PER_KWH / power_w
    return bsfc


def battery_limits_w(
    battery: BatteryParams, soc: FloatArray, held_s: float = 1e-9
) -> tuple[FloatArray, FloatArray]:
    """Charge and discharge power that can be held for ``held_s`` over SOC, magnitudes [W].

    By default for no time at all: what voltage and current allow.
    """
    inside = np.clip(soc, battery.soc_min + 1e-9, battery.soc_max - 1e-9)
    return power_limits_w(battery, inside, held_s)


def round_trip_efficiency(battery: BatteryParams, soc: float, power_w: FloatArray) -> FloatArray:
    """Energy out over energy in for the same charge, both at ``power_w`` of the terminals.

    (OCV - R I_out) / (OCV + R I_in) at one SOC; NaN above OCV^2 / 4R. Shape of ``power_w``.
    """
    ocv_v = open_circuit_v(battery, np.array(soc))
    ohm = battery.resistance_ohm
    room = ocv_v**2 - 4.0 * ohm * power_w
    under_load_v = (ocv_v + np.sqrt(np.where(room >= 0.0, room, np.nan))) / 2.0
    charging_v = (ocv_v + np.sqrt(ocv_v**2 + 4.0 * ohm * power_w)) / 2.0
    return np.asarray(under_load_v / charging_v, dtype=np.float64)
