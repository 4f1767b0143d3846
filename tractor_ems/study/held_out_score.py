"""Fourth stage of the held-out study: the official score of every run, certified, to its own end.
For disturbed runs the reference is interpolated instead; see ``tuning.reference``."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tractor_ems.optimal.score import dp_ratio
from tractor_ems.study.disturbances import NONE, Disturbance, disturbed
from tractor_ems.study.held_out_record import scenario_of
from tractor_ems.study.pieces import code_digest, digest_of, load_piece, save_piece
from tractor_ems.tuning.reference import Reference
from tractor_msgs_py.errors import RunAborted, TractorEmsError
from tractor_sim.duty_cycle.cycle import cycle_hash
from tractor_sim.powertrain_json import powertrain_hash

_CODE = ("tractor_ems/optimal", "tractor_sim/battery.py", "tractor_sim/engine.py")


@dataclass(frozen=True)
class Scoring:
    """One run to score: what it drove, from where to where, on how much fuel."""

    powertrain: str
    cycle: str
    scale: float
    soc_initial: float
    soc_final: float
    fuel_kg: float
    folder: Path

    @property
    def key(self) -> str:
        """Hash of all that decides the score; also its file's name."""
        scenario = scenario_of(self.powertrain, self.cycle, self.scale)
        params, cycle = powertrain_hash(scenario.params), cycle_hash(scenario.cycle)
        run = [self.soc_initial, self.soc_final, self.fuel_kg]
        return digest_of([params, cycle, run, code_digest(*_CODE)])


def scoring_of(row: Mapping[str, Any], powertrain: str, folder: Path) -> Scoring:
    """What to score of a row of ``held_out_drive``."""
    return Scoring(
        powertrain,
        row["cycle"],
        1.0,
        row["soc_initial"],
        row["soc_final"],
        row["fuel_kg"],
        folder,
    )


def score(task: Scoring) -> dict[str, Any]:
    """``{"dp_ratio", "note"}``; the ratio is None where no grid could be certified."""
    key = task.key
    piece = task.folder / key[:2] / f"{key[:20]}.json"
    found = load_piece(piece, key)
    if found is None:
        scenario = scenario_of(task.powertrain, task.cycle, task.scale)
        ratio, note = None, None
        try:
            ratio = dp_ratio(
                scenario.params,
                scenario.power_demand_w,
                task.soc_initial,
                task.soc_final,
                task.fuel_kg,
            )
        except TractorEmsError as error:
            note = " ".join(str(error).split())
        found = {"dp_ratio": ratio, "note": note}
        save_piece(piece, key, found)
    return found


def scored(row: Mapping[str, Any], found: Mapping[str, Any], bug: float) -> dict[str, Any]:
    """The row with its score. A run with shortfall has none: undelivered work does not score.

    Raises:
        RunAborted: a ratio above ``bug``: nothing beats the optimum, so something is wrong.
    """
    if row["shortfall_j"] > 0.0:
        note = f"shortfall of {row['shortfall_j']:.0f} J"
        return {**row, "dp_ratio": None, "note": note}
    ratio = found["dp_ratio"]
    if ratio is not None and ratio > bug:
        raise RunAborted(
            f"{row['policy']} seed {row['seed']} on {row['cycle']}: dp_ratio {ratio:.6f} above "
            f"{bug}: a run that beats the optimum is a bug"
        )
    return {**row, "dp_ratio": ratio, "note": found["note"]}


@dataclass(frozen=True)
class Optima:
    """Least fuel of one cycle on one plant, to many ends.

    Attributes:
        powertrain, cycle, scale: what is driven; disturbance: what is wrong with the plant.
        ends: final SOC of the runs, each from the powertrain's initial SOC.
        exact: solve every end (not certified); False: interpolate over final SOC.
        folder: where solved ends are kept.
    """

    powertrain: str
    cycle: str
    ends: tuple[float, ...]
    folder: Path
    scale: float = 1.0
    disturbance: Disturbance = NONE
    exact: bool = False


def optima(task: Optima) -> list[float]:
    """Least fuel to each end [kg]."""
    scenario = scenario_of(task.powertrain, task.cycle, task.scale)
    plant = disturbed(scenario.params, task.disturbance)
    identity = [powertrain_hash(plant), cycle_hash(scenario.cycle), code_digest(*_CODE)]
    path = task.folder / f"{digest_of(identity)[:20]}.json"
    reference = Reference(plant, scenario.power_demand_w, scenario.soc_initial, path)
    solve = reference.solved_kg if task.exact else reference.fuel_kg
    return [solve(end) for end in task.ends]


def ratios(rows: Sequence[Mapping[str, Any]], fuel_kg: Sequence[float]) -> list[float | None]:
    """Score of rows against the least fuel to their ends; None where there was shortfall."""
    return [
        None
        if row["shortfall_j"] > 0.0
        else 1.0
        if row["fuel_kg"] == 0.0
        else least / row["fuel_kg"]
        for row, least in zip(rows, fuel_kg, strict=True)
    ]
