"""Numbers of a row over its seeds, and the names and groups that tables and figures share."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from tractor_ems.study.convergence import RowConvergence, converged, convergence_over_seeds
from tractor_ems.study.results import Baseline, Outcome, Run, StudyResults
from tractor_ems.study.statistics import Interval, iqm_interval
from tractor_sim.fuel import gallons

NOT_RUN = "not run"
SOC_MINS = (0.70, 0.836)

_RNG_SEED = 20_260
"""Of every bootstrap here: the same results give the same tables."""

ROW_NAMES: Mapping[str, str] = {
    "q": "Q-learning",
    "double_q": "double Q-learning",
    "double_q_interpolated": "double Q, interpolated",
    "dqn": "DQN",
    "ddqn": "DDQN",
    "ddqn_soft_target": "DDQN, soft target",
    "ddqn_fuel_knots": "DDQN, engine knots",
    "ddqn_shaped": "DDQN, shaped",
    "ddqn_shaped_dp": "DDQN, shaped, DP seeds",
    "ddqn_shaped_mixed": "DDQN, shaped, DP + rule seeds",
    "ddqn_shaped_rule": "DDQN, shaped, rule seeds",
    "ddqn_shaped_continuous_soc": "DDQN, shaped, continuous SOC",
    "ddqn_shaped_knots": "DDQN, shaped, engine knots",
    "ddqn_shaped_dp_kept": "DDQN, shaped, DP kept",
    "ddqn_shaped_dp_margin": "DDQN, shaped, DP kept, margin",
    "ddqn_corrected": "DDQN, corrected reward",
    "ddqn_corrected_knots": "DDQN, corrected, engine knots",
}

BASELINE_NAMES: Mapping[str, str] = {
    "conventional": "conventional",
    "dp": "DP, least fuel to 83.6 %",
    "best_point": "best point (engine at its best power)",
    "rule_based": "rule base (engine above 110 kW)",
    "random_feasible": "random feasible",
    "myopic": "myopic greedy on the reward",
    "optimum": "exact optimum of the reward",
}

REWARD_NAMES: Mapping[str, str] = {
    "fuel": "fuel",
    "piecewise": "shaped, as printed",
    "piecewise_corrected": "shaped, corrected",
    "equivalent_fuel": "equivalent fuel",
}

ABLATIONS: Sequence[tuple[str, Sequence[str]]] = (
    ("double_q@0.7", ("double_q_interpolated@0.7",)),
    ("ddqn@0.7", ("ddqn_soft_target@0.7", "ddqn_fuel_knots@0.7")),
    ("ddqn_shaped@0.7", ("ddqn_corrected@0.7", "ddqn_corrected_knots@0.7")),
    ("ddqn_shaped@0.836", ("ddqn_shaped_continuous_soc@0.836", "ddqn_shaped_knots@0.836")),
    ("ddqn_shaped_dp@0.836", ("ddqn_shaped_dp_kept@0.836", "ddqn_shaped_dp_margin@0.836")),
)
"""A row of the paper, and the rows that change one thing of it."""


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


def find_baseline(
    results: StudyResults, name: str, reward: str = "fuel", soc_min: float = 0.70
) -> Baseline | None:
    """A baseline, None where the study has none."""
    try:
        return results.baseline(name, reward, soc_min)
    except KeyError:
        return None


def row_name(key: str) -> str:
    """What a reader calls the row of this key."""
    name = key.split("@")[0]
    return ROW_NAMES.get(name, name)


def soc_min_of(key: str) -> float:
    """SOC_min of a row key."""
    return float(key.split("@")[1])
