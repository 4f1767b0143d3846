"""Numbers of a row over its seeds, and the names and groups that tables and figures share."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from tractor_ems.study.convergence import (
    RowConvergence,
    converged,
    convergence_over_seeds,
    reached_optimum,
)
from tractor_ems.study.names import (
    BASELINE_NAMES,
    REWARD_NAMES,
    ROW_NAMES,
    SOC_MINS,
    full_name,
    reward_name,
    row_name,
    soc_min_of,
    soc_min_text,
)
from tractor_ems.study.results import Baseline, Outcome, Run, StudyResults
from tractor_ems.study.statistics import Interval, iqm_interval
from tractor_sim.fuel import gallons

__all__ = [
    "ABLATIONS",
    "ALSO_AGAINST",
    "BASELINE_NAMES",
    "NOT_RUN",
    "REWARD_NAMES",
    "ROW_NAMES",
    "SOC_MINS",
    "Measure",
    "episodes_to_convergence",
    "episodes_to_optimum",
    "find_baseline",
    "fuel_gal",
    "full_name",
    "measure",
    "measure_values",
    "reward_name",
    "row_name",
    "soc_min_of",
    "soc_min_text",
]

NOT_RUN = "not run"

_RNG_SEED = 20_260
"""Of every bootstrap here: the same results give the same tables."""

ABLATIONS: Sequence[tuple[str, Sequence[str]]] = (
    ("double_q@0.7", ("double_q_interpolated@0.7",)),
    ("ddqn@0.7", ("ddqn_soft_target@0.7", "ddqn_fuel_knots@0.7")),
    ("ddqn_shaped@0.7", ("ddqn_corrected@0.7", "ddqn_corrected_knots@0.7")),
    ("ddqn_shaped@0.836", ("ddqn_shaped_continuous_soc@0.836", "ddqn_shaped_knots@0.836")),
    ("ddqn_shaped_dp@0.836", ("ddqn_shaped_dp_kept@0.836", "ddqn_shaped_dp_margin@0.836")),
)
"""A row of the paper, and the rows that change something of it. Some change several things: the
table computes which."""

ALSO_AGAINST: Mapping[str, str] = {
    "ddqn_shaped_dp_margin@0.836": "ddqn_shaped_dp_kept@0.836",
    "ddqn_corrected_knots@0.7": "ddqn_corrected@0.7",
}
"""Ablations that have a nearer neighbour than the row of the paper."""


@dataclass(frozen=True)
class Measure:
    """A quantity over the seeds of a row.

    Attributes:
        interval: interquartile mean and 95 % interval over the seeds that have it.
        values: of those seeds, in their order.
        missing: seeds that have none.
    """

    interval: Interval
    values: tuple[float, ...]
    missing: int


def measure(runs: Sequence[Run], get: Callable[[Outcome], float | None]) -> Measure | None:
    """A quantity of the final drives; None where no seed has it."""
    return measure_values([get(run.outcome) for run in runs])


def measure_values(values: Sequence[float | None]) -> Measure | None:
    """As ``measure``, from plain values."""
    found = tuple(value for value in values if value is not None)
    if not found:
        return None
    return Measure(_interval(found), found, len(values) - len(found))


@lru_cache(maxsize=4096)
def _interval(values: tuple[float, ...]) -> Interval:
    """Many tables show the same quantity of the same row."""
    return iqm_interval(np.array(values), np.random.default_rng(_RNG_SEED))


def fuel_gal(outcome: Outcome) -> float:
    """Fuel [US gal]."""
    return gallons(outcome.fuel_kg)


def episodes_to_convergence(runs: Sequence[Run]) -> RowConvergence | None:
    """The study's rule over the seeds of a row; None where it was not run."""
    if not runs:
        return None
    found = [converged(run.curve.episode, run.curve.eval_return) for run in runs]
    return convergence_over_seeds(found, np.random.default_rng(_RNG_SEED))


def episodes_to_optimum(results: StudyResults, runs: Sequence[Run]) -> RowConvergence | None:
    """Episodes to 95 % of the way from random feasible to the exact optimum of the reward; None
    where the row was not run or the study has no such references."""
    if not runs:
        return None
    row = runs[0].row
    low = find_baseline(results, "random_feasible", row.reward, row.soc_min)
    high = find_baseline(results, "optimum", row.reward, row.soc_min)
    if low is None or high is None or low.outcome.reward_sum >= high.outcome.reward_sum:
        return None
    ends = low.outcome.reward_sum, high.outcome.reward_sum
    found = [reached_optimum(run.curve.episode, run.curve.eval_return, *ends) for run in runs]
    return convergence_over_seeds(found, np.random.default_rng(_RNG_SEED))


def find_baseline(
    results: StudyResults, name: str, reward: str = "fuel", soc_min: float = 0.70
) -> Baseline | None:
    """A baseline, None where the study has none."""
    try:
        return results.baseline(name, reward, soc_min)
    except KeyError:
        return None
