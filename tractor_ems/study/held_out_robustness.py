"""Fifth stage of the held-out study: the same policies where plant or signals are not what they
believe, scored against the optimum of the plant as it really is."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tractor_ems.study.disturbances import NONE, Disturbance, disturbed, interference_of
from tractor_ems.study.held_out_drive import drive_batch, row_of
from tractor_ems.study.held_out_policies import Driver, made_policy
from tractor_ems.study.held_out_record import scenario_of
from tractor_ems.study.held_out_score import Optima, ratios
from tractor_ems.study.pieces import code_digest, digest_of, load_piece, save_piece
from tractor_sim.duty_cycle.cycle import cycle_hash
from tractor_sim.powertrain_json import powertrain_hash

_CODE = ("tractor_ems/study/held_out_robustness.py", "tractor_ems/study/disturbances.py")

KEPT = ("policy", "seed", "cycle", "operation", "fuel_kg", "soc_final", "shortfall_j")
"""Keys of a run's row that are kept, besides the disturbance, starts and violations."""


@dataclass(frozen=True)
class Disturbing:
    """One policy over some cycles under every disturbance; ``piece``: where its rows are kept."""

    driver: Driver
    powertrain: str
    cycles: tuple[str, ...]
    disturbances: tuple[Disturbance, ...]
    piece: Path

    @property
    def key(self) -> str:
        """Hash of everything that decides the rows."""
        scenarios = [scenario_of(self.powertrain, name) for name in self.cycles]
        cycles = [cycle_hash(scenario.cycle) for scenario in scenarios]
        listed = [asdict(item) for item in self.disturbances]
        params = powertrain_hash(scenarios[0].params)
        return digest_of([self.driver.identity, params, cycles, listed, code_digest(*_CODE)])


def drive_disturbed(task: Disturbing) -> list[dict[str, Any]]:
    """A row per disturbance and cycle; the first are undisturbed and called ``none``."""
    key = task.key
    found = load_piece(task.piece, key)
    if found is None:
        found = {"rows": _rows(task)}
        save_piece(task.piece, key, found)
    rows: list[dict[str, Any]] = found["rows"]
    return rows


def _rows(task: Disturbing) -> list[dict[str, Any]]:
    scenarios = [scenario_of(task.powertrain, name) for name in task.cycles]
    believed = scenarios[0].params
    policy = made_policy(task.driver, believed)
    plants: dict[tuple[float, float, float], list[Disturbance]] = defaultdict(list)
    for disturbance in (NONE, *task.disturbances):
        plants[disturbance.plant].append(disturbance)
    rows = []
    for members in plants.values():
        plant = disturbed(believed, members[0])
        pairs = [(d, n) for d in members for n in range(len(scenarios))]
        lengths = {len(scenario.cycle) for scenario in scenarios}
        interference = {}
        for steps in lengths:
            here = [(d, n) for d, n in pairs if len(scenarios[n].cycle) == steps]
            seeds = [n for _, n in here]
            interference[steps] = interference_of(
                [d for d, _ in here], steps, believed.dt_s, seeds
            )
        runs = drive_batch(policy, [scenarios[n] for _, n in pairs], plant, interference)
        for (disturbance, n), run in zip(pairs, runs, strict=True):
            row = row_of(task.driver, scenarios[n], run, plant)
            rows.append(
                {
                    "disturbance": disturbance.name,
                    **{name: row[name] for name in KEPT},
                    "engine_starts": row["engine_starts"],
                    "violations": row["violations"],
                }
            )
    return rows


def optima_of(
    rows: Sequence[dict[str, Any]],
    powertrain: str,
    disturbances: Sequence[Disturbance],
    folder: Path,
) -> tuple[list[Optima], list[list[int]]]:
    """What to solve for the rows: a task per plant and cycle, and the rows that it serves."""
    by_name = {item.name: item for item in (NONE, *disturbances)}
    groups: dict[tuple[tuple[float, float, float], str], list[int]] = defaultdict(list)
    for number, row in enumerate(rows):
        if row["shortfall_j"] == 0.0:
            groups[(by_name[row["disturbance"]].plant, row["cycle"])].append(number)
    tasks = [
        Optima(
            powertrain,
            cycle,
            tuple(rows[n]["soc_final"] for n in numbers),
            folder,
            disturbance=by_name[rows[numbers[0]]["disturbance"]],
        )
        for (_, cycle), numbers in groups.items()
    ]
    return tasks, list(groups.values())


def scored_rows(
    rows: Sequence[dict[str, Any]], served: Sequence[Sequence[int]], fuel_kg: Sequence[list[float]]
) -> list[dict[str, Any]]:
    """The rows with their scores in place of their fuel; None where there was shortfall."""
    made: list[dict[str, Any]] = [{**row, "dp_ratio": None} for row in rows]
    for row in made:
        del row["fuel_kg"], row["operation"]
    for numbers, least in zip(served, fuel_kg, strict=True):
        for number, ratio in zip(numbers, ratios([rows[n] for n in numbers], least), strict=True):
            made[number]["dp_ratio"] = ratio
    return made
