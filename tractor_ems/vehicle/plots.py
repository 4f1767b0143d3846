"""A vehicle's curves in one picture: data and hull, losses, marginal fuel, battery."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from tractor_ems.plots import COLOURS
from tractor_ems.vehicle.curves import (
    FuelCurves,
    Vehicle,
    battery_limits_w,
    bsfc_g_per_kwh,
    efficiency_of,
    fuel_curves,
    round_trip_efficiency,
)
from tractor_msgs_py.atomic import write_bytes_with
from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.battery import open_circuit_v

HELD_S = 30.0
"""The picture shows battery power that can be held for as long [s]."""

_DATA, _DRIVEN = COLOURS[1], COLOURS[0]


def plot_vehicle(path: Path, vehicle: Vehicle) -> None:
    """Nine panels: engine over crankshaft power, generator and fuel over bus power, battery.

    Raises:
        ConfigError: ``path`` cannot be written.
    """
    curves = fuel_curves(vehicle)
    figure = Figure(figsize=(13, 10.5))
    figure.subplots_adjust(0.055, 0.05, 0.985, 0.93, 0.2, 0.33)
    FigureCanvasAgg(figure)
    figure.suptitle(f"powertrain {vehicle.params.name}")
    panels = figure.subplots(3, 3)
    _engine(panels[0], vehicle, curves)
    _bus(panels[1], vehicle, curves)
    _battery(panels[2], vehicle)
    for axes in figure.axes:
        axes.grid(alpha=0.3)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(fontsize="small")
    write_bytes_with(path, lambda file: figure.savefig(file, format="png", dpi=72))


def _two(
    axes: Axes, vehicle: Vehicle, x_w: FloatArray, data: FloatArray, hull: FloatArray
) -> None:
    """Data and hull; what is driven is the solid line."""
    driven = vehicle.from_efficiency
    axes.plot(x_w / 1e3, data, color=_DATA, linestyle="-" if driven else "--", label="data")
    axes.fill_between(x_w / 1e3, hull, data, color=_DATA, alpha=0.2, linewidth=0)
    label = "convex hull" if driven else "convex hull, driven"
    axes.plot(x_w / 1e3, hull, color=_DRIVEN, linestyle="--" if driven else "-", label=label)


def _engine(row: FloatArray, vehicle: Vehicle, curves: FuelCurves) -> None:
    lhv, crank_w = vehicle.params.engine.fuel_lhv_j_per_kg, curves.crank_w
    both = (curves.data_kg_per_s, curves.hull_kg_per_s)
    _two(row[0], vehicle, crank_w, *(fuel * 1e3 for fuel in both))
    row[0].set(ylabel="fuel while on [g/s]", title="engine: fuel", ylim=(0, None))
    _two(row[1], vehicle, crank_w, *(efficiency_of(crank_w, f, lhv) * 100 for f in both))
    row[1].set(ylabel="efficiency [%]", title="engine: efficiency", ylim=(0, None))
    above = slice(int(np.searchsorted(crank_w, 0.08 * crank_w[-1])), None)
    _two(
        row[2],
        vehicle,
        crank_w[above],
        *(bsfc_g_per_kwh(crank_w[above], f[above]) for f in both),
    )
    row[2].set(ylabel="BSFC [g/kWh]", title="engine: specific fuel from 8 % load on")
    for axes in row:
        axes.set_xlabel("crankshaft power [kW]")


def _bus(row: FloatArray, vehicle: Vehicle, curves: FuelCurves) -> None:
    crank_w, bus_w = curves.crank_w[1:], curves.bus_w
    row[0].plot(crank_w / 1e3, bus_w[1:] / crank_w * 100, color=_DRIVEN)
    row[0].set(
        xlabel="crankshaft power [kW]",
        ylabel="efficiency [%]",
        title="generator and rectifier",
        ylim=(None, 100.5),
    )
    _two(row[1], vehicle, bus_w, curves.data_kg_per_s * 1e3, curves.hull_kg_per_s * 1e3)
    row[1].set(
        xlabel="bus power [kW]",
        ylabel="fuel while on [g/s]",
        title="fuel at the bus",
        ylim=(0, None),
    )
    middle_w = (bus_w[1:] + bus_w[:-1]) / 2.0
    marginal = [
        np.diff(fuel) / np.diff(bus_w) * 3.6e9
        for fuel in (curves.data_kg_per_s, curves.hull_kg_per_s)
    ]
    _two(row[2], vehicle, middle_w, *marginal)
    row[2].set(
        xlabel="bus power [kW]",
        ylabel="fuel of one more kWh [g]",
        title="marginal fuel at the bus",
        ylim=(0, float(np.quantile(marginal[0], 0.98)) * 1.3),
    )


def _battery(row: FloatArray, vehicle: Vehicle) -> None:
    battery, soc_0 = vehicle.params.battery, vehicle.params.soc_initial
    soc = np.linspace(battery.soc_min, battery.soc_max, 300)
    row[0].plot(soc * 100, open_circuit_v(battery, soc), color=_DRIVEN, label="open circuit")
    row[0].axvline(soc_0 * 100, color="grey", linestyle=":", label="initial SOC")
    row[0].set(xlabel="SOC [%]", ylabel="voltage [V]", title="battery: OCV over the window")
    charge_w, discharge_w = battery_limits_w(battery, soc, HELD_S)
    row[1].plot(soc * 100, discharge_w / 1e3, color=_DRIVEN, label="discharge")
    row[1].plot(soc * 100, charge_w / 1e3, color=_DATA, linestyle="--", label="charge")
    row[1].set(
        xlabel="SOC [%]",
        ylabel="power limit [kW]",
        title=f"battery: power held for {HELD_S:g} s",
        ylim=(0, None),
    )
    power_w = np.linspace(0.0, battery.power_max_w, 200)
    for label, at, style in (("soc_min", battery.soc_min, ":"), ("initial SOC", soc_0, "-")):
        efficiency = round_trip_efficiency(battery, at, power_w)
        row[2].plot(power_w / 1e3, efficiency * 100, color=_DRIVEN, linestyle=style, label=label)
    row[2].set(
        xlabel="power, in and out [kW]", ylabel="efficiency [%]", title="battery: round trip"
    )
    row[2].set_ylim(None, 100.5)
