"""The numbers of a finished run, computed from its trajectory alone."""

from typing import TypedDict

import numpy as np

from tractor_msgs_py.trajectory import Trajectory, trajectory_hash
from tractor_sim.fuel import gallons
from tractor_sim.generator import to_crank_w
from tractor_sim.powertrain import PowertrainParams


class RunFigures(TypedDict):
    """What every report of a run holds.

    ``efficiency`` is crankshaft work over fuel energy, None when nothing was burnt;
    ``engine_starts`` counts from an engine that is off before the first step.
    """

    fuel_kg: float
    fuel_gal: float
    efficiency: float | None
    soc_final: float
    engine_starts: int
    shortfall_j: float
    dissipated_j: float
    steps: int
    trajectory_hash: str


def run_figures(trajectory: Trajectory, params: PowertrainParams) -> RunFigures:
    """The figures of one run on one powertrain."""
    engine = params.engine
    fuel_kg = float(trajectory.fuel_kg.sum())
    crank_w = to_crank_w(params.generator, trajectory.engine_power_w, engine.power_max_w)
    work_j = float(crank_w.sum()) * params.dt_s
    before = np.concatenate(([False], trajectory.engine_on[:-1]))
    return RunFigures(
        fuel_kg=fuel_kg,
        fuel_gal=gallons(fuel_kg),
        efficiency=work_j / (fuel_kg * engine.fuel_lhv_j_per_kg) if fuel_kg > 0 else None,
        soc_final=trajectory.soc_final,
        engine_starts=int(np.count_nonzero(trajectory.engine_on & ~before)),
        shortfall_j=float(trajectory.shortfall_j.sum()),
        dissipated_j=float(trajectory.dissipated_j.sum()),
        steps=len(trajectory),
        trajectory_hash=trajectory_hash(trajectory),
    )
