"""The numbers of a finished run, computed from its trajectory alone. docs/metrics.md defines them
for readers; what needs the cycle or a target as well is added in ``tractor_ems.result``.
"""

from typing import TypedDict

import numpy as np

from tractor_msgs_py.trajectory import Trajectory, trajectory_hash
from tractor_sim.fuel import gallons, litres
from tractor_sim.generator import to_crank_w
from tractor_sim.powertrain import PowertrainParams

LOW_POWER_W = 60e3
"""Crankshaft power below which an engine of the paper's size burns more than it should [W]."""

S_PER_H = 3600.0
J_PER_KWH = 3.6e6


class RunFigures(TypedDict):
    """What every report of a run holds.

    fuel_kg, fuel_l, fuel_gal: fuel burnt, start fuel included.
    fuel_l_per_h: over the whole run, engine on or off.
    efficiency: crankshaft work over fuel energy; bus_efficiency: engine energy that reached the
        bus over fuel energy. None when nothing was burnt.
    engine_starts: counted from an engine that is off before the first step.
    engine_starts_per_h: over the whole run.
    engine_h: time the engine was on. below_60kw_s: of this, the time below 60 kW of crankshaft
        power, idling included.
    battery_throughput_kwh: energy into the terminals plus energy out of them.
    equivalent_full_cycles: that over twice the nominal energy, SOC 0 to 1.
    soc_min, soc_max: extremes from the first to the last moment; soc_excursion: their distance.
    shortfall_j: demand that was not met. dissipated_j: energy that had to be braked away.
    duration_s: time driven.
    """

    fuel_kg: float
    fuel_l: float
    fuel_gal: float
    fuel_l_per_h: float
    efficiency: float | None
    bus_efficiency: float | None
    soc_final: float
    soc_min: float
    soc_max: float
    soc_excursion: float
    engine_starts: int
    engine_starts_per_h: float
    engine_h: float
    below_60kw_s: float
    battery_throughput_kwh: float
    equivalent_full_cycles: float
    shortfall_j: float
    dissipated_j: float
    duration_s: float
    steps: int
    trajectory_hash: str


def run_figures(trajectory: Trajectory, params: PowertrainParams) -> RunFigures:
    """The figures of one run, of at least one step, on one powertrain."""
    engine, dt_s = params.engine, params.dt_s
    on, bus_w = trajectory.engine_on, trajectory.engine_power_w
    fuel_kg = float(trajectory.fuel_kg.sum())
    fuel_j = fuel_kg * engine.fuel_lhv_j_per_kg
    crank_w = to_crank_w(params.generator, bus_w, engine.power_max_w)
    before = np.concatenate(([False], on[:-1]))
    starts = int(np.count_nonzero(on & ~before))
    soc = np.append(trajectory.soc, trajectory.soc_final)
    soc_min, soc_max = float(soc.min()), float(soc.max())
    throughput_j = float(np.abs(trajectory.battery_power_w).sum()) * dt_s
    duration_s = len(trajectory) * dt_s
    hours = duration_s / S_PER_H
    return RunFigures(
        fuel_kg=fuel_kg,
        fuel_l=litres(fuel_kg),
        fuel_gal=gallons(fuel_kg),
        fuel_l_per_h=litres(fuel_kg) / hours,
        efficiency=float(crank_w.sum()) * dt_s / fuel_j if fuel_kg > 0 else None,
        bus_efficiency=float(bus_w.sum()) * dt_s / fuel_j if fuel_kg > 0 else None,
        soc_final=trajectory.soc_final,
        soc_min=soc_min,
        soc_max=soc_max,
        soc_excursion=soc_max - soc_min,
        engine_starts=starts,
        engine_starts_per_h=starts / hours,
        engine_h=int(np.count_nonzero(on)) * dt_s / S_PER_H,
        below_60kw_s=int(np.count_nonzero(on & (crank_w < LOW_POWER_W))) * dt_s,
        battery_throughput_kwh=throughput_j / J_PER_KWH,
        equivalent_full_cycles=throughput_j / (2.0 * params.battery.energy_j),
        shortfall_j=float(trajectory.shortfall_j.sum()),
        dissipated_j=float(trajectory.dissipated_j.sum()),
        duration_s=duration_s,
        steps=len(trajectory),
        trajectory_hash=trajectory_hash(trajectory),
    )
