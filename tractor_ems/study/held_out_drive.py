"""Third stage of the held-out study: every policy over every cycle on the real plant, one row a
run. Batched over cycles of equal length."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from tractor_ems.drive import Interference, drive
from tractor_ems.policies.protocol import Policy
from tractor_ems.policies.registry import make_policy
from tractor_ems.result import count_violations
from tractor_ems.scenario import Scenario
from tractor_ems.study.held_out_policies import DP, Driver, made_policy
from tractor_ems.study.held_out_record import scenario_of
from tractor_ems.study.pieces import code_digest, digest_of, load_piece, save_piece
from tractor_msgs_py.trajectory import Trajectory
from tractor_sim.duty_cycle.cycle import cycle_hash
from tractor_sim.figures import run_figures
from tractor_sim.powertrain import PowertrainParams
from tractor_sim.powertrain_json import powertrain_hash

_CODE = ("tractor_ems/study/held_out_drive.py", "tractor_ems/result.py")

TRACE_EVERY = 5
"""Steps between the points of a trace that is kept."""

FIGURES = (
    "fuel_kg",
    "soc_final",
    "soc_min",
    "soc_max",
    "engine_starts",
    "engine_h",
    "shortfall_j",
    "dissipated_j",
)


@dataclass(frozen=True)
class Driving:
    """One policy over many cycles.

    Attributes:
        driver: who; powertrain: name; cycles: names; scale: factor on their demand.
        refit: see ``held_out_policies.made_policy``.
        traces: cycles whose traces are kept.
        piece: where its rows are kept.
    """

    driver: Driver
    powertrain: str
    cycles: tuple[str, ...]
    piece: Path
    scale: float = 1.0
    refit: bool = False
    traces: tuple[str, ...] = ()

    @property
    def key(self) -> str:
        """Hash of everything that decides the rows."""
        scenarios = [scenario_of(self.powertrain, name, self.scale) for name in self.cycles]
        cycles = [(s.cycle.name, cycle_hash(s.cycle)) for s in scenarios]
        params = powertrain_hash(scenarios[0].params) if scenarios else ""
        code = code_digest(*_CODE)
        return digest_of(
            [self.driver.identity, params, cycles, self.refit, list(self.traces), code]
        )


def drive_all(task: Driving) -> dict[str, Any]:
    """Rows of every cycle, in order, and the traces: ``{"rows": [...], "traces": {...}}``."""
    key = task.key
    found = load_piece(task.piece, key)
    if found is None:
        scenarios = [scenario_of(task.powertrain, name, task.scale) for name in task.cycles]
        runs = _runs(task, scenarios)
        rows = [
            row_of(task.driver, scenario, run, scenario.params)
            for scenario, run in zip(scenarios, runs, strict=True)
        ]
        traces = {
            name: trace_of(run, scenario.params)
            for name, scenario, run in zip(task.cycles, scenarios, runs, strict=True)
            if name in task.traces
        }
        found = {"rows": rows, "traces": traces}
        save_piece(task.piece, key, found)
    return found


def _runs(task: Driving, scenarios: Sequence[Scenario]) -> list[Trajectory]:
    if task.driver.name == DP:
        return [
            drive_batch(make_policy(DP, scenario), [scenario], scenario.params)[0]
            for scenario in scenarios
        ]
    policy = made_policy(task.driver, scenarios[0].params, refit=task.refit)
    return drive_batch(policy, scenarios, scenarios[0].params)


def drive_batch(
    policy: Policy,
    scenarios: Sequence[Scenario],
    plant: PowertrainParams,
    interference: Mapping[int, Interference] | None = None,
) -> list[Trajectory]:
    """One policy over scenarios of any lengths, in order.

    Args:
        plant: what is really driven.
        interference: by cycle length, for the scenarios of that length in their order.
    """
    order = sorted(range(len(scenarios)), key=lambda n: len(scenarios[n].cycle))
    runs: dict[int, Trajectory] = {}
    for steps, numbers in groupby(order, key=lambda n: len(scenarios[n].cycle)):
        group = list(numbers)
        made = drive(
            policy,
            plant,
            np.stack([scenarios[n].power_demand_w for n in group]),
            np.array([scenarios[n].soc_initial for n in group]),
            np.array([scenarios[n].soc_target for n in group]),
            interference=None if interference is None else interference[steps],
        )
        runs.update(zip(group, made, strict=True))
    return [runs[n] for n in range(len(scenarios))]


def row_of(
    driver: Driver, scenario: Scenario, run: Trajectory, plant: PowertrainParams
) -> dict[str, Any]:
    """One run in figures of ``docs/metrics.md``, not yet scored."""
    figures: dict[str, Any] = {**run_figures(run, plant)}
    hours = len(scenario.cycle) * plant.dt_s / 3600.0
    return {
        "policy": driver.name,
        "seed": driver.seed,
        "cycle": scenario.cycle_source,
        "operation": scenario.cycle.operation,
        "hours": hours,
        "soc_initial": float(run.soc[0]),
        "soc_target": scenario.soc_target,
        **{name: figures[name] for name in FIGURES},
        "violations": count_violations(run, plant),
    }


def trace_of(run: Trajectory, plant: PowertrainParams) -> dict[str, list[float]]:
    """A thinned trace: time [s], demand and engine power [kW], SOC."""
    at = slice(None, None, TRACE_EVERY)
    time_s = plant.dt_s * np.arange(len(run))[at]
    return {
        "time_s": np.round(time_s, 3).tolist(),
        "demand_kw": np.round(run.power_demand_w[at] / 1e3, 1).tolist(),
        "engine_kw": np.round(run.engine_power_w[at] / 1e3, 1).tolist(),
        "soc": np.round(run.soc[at], 4).tolist(),
    }
