"""How a number becomes a verdict: intervals against thresholds, and how parts combine."""

from collections.abc import Callable, Iterable
from typing import Literal, TypeAlias

import numpy as np

from tractor_ems.study.results import Baseline, Outcome, StudyResults
from tractor_ems.study.statistics import Interval, iqm_interval
from tractor_msgs_py.trajectory import FloatArray

Verdict = Literal["holds", "does not hold", "not resolved", "calibrated"]

Found: TypeAlias = tuple[Verdict, str]
"""A verdict and its evidence."""

OPEN: Verdict = "not resolved"

_RNG_SEED = 20_260


def rng() -> np.random.Generator:
    """A fresh generator for one bootstrap: the same results give the same verdicts, in any
    order of the claims."""
    return np.random.default_rng(_RNG_SEED)


def above(interval: Interval, threshold: float) -> Verdict:
    """Holds where the whole interval is at the threshold or above, fails where it is below."""
    if interval.low >= threshold:
        return "holds"
    return "does not hold" if interval.high < threshold else OPEN


def below(interval: Interval, threshold: float) -> Verdict:
    """Holds where the whole interval is below the threshold, fails where it is at or above."""
    if interval.high < threshold:
        return "holds"
    return "does not hold" if interval.low >= threshold else OPEN


def within(interval: Interval, value: float, margin: float) -> Verdict:
    """Sameness is shown, not assumed: the whole interval must lie within the margin."""
    if value - margin <= interval.low and interval.high <= value + margin:
        return "holds"
    if interval.high < value - margin or interval.low > value + margin:
        return "does not hold"
    return OPEN


def all_hold(verdicts: Iterable[Verdict]) -> Verdict:
    """A claim of several parts: one that fails refutes it, one left open leaves it open."""
    found = set(verdicts)
    if "does not hold" in found:
        return "does not hold"
    return OPEN if OPEN in found else "holds"


def unresolved(why: str) -> Found:
    """Not resolved, and why."""
    return OPEN, why


def join(*parts: str) -> str:
    """Evidence in one line, without the parts that are empty."""
    return "; ".join(part for part in parts if part)


def values_of(results: StudyResults, key: str, read: Callable[[Outcome], float]) -> FloatArray:
    """A number of every run of a row, shape (S,)."""
    return np.array([read(run.outcome) for run in results.of(key)], dtype=np.float64)


def defined_of(
    results: StudyResults, key: str, read: Callable[[Outcome], float | None]
) -> list[float]:
    """The same where it is defined."""
    found = [read(run.outcome) for run in results.of(key)]
    return [value for value in found if value is not None]


def iqm_text(values: FloatArray | list[float], digits: int = 3) -> str:
    """Interquartile mean with its interval; a dash where there are none."""
    if len(values) == 0:
        return "-"
    return iqm_interval(values, rng()).text(digits)


def dp_ratio_text(results: StudyResults, key: str) -> str:
    """Matched-SOC DP ratio of a row, and how many runs have none."""
    values = defined_of(results, key, lambda outcome: outcome.dp_ratio)
    missing = len(results.of(key)) - len(values)
    return iqm_text(values, 4) + (f" ({missing} runs without)" if missing else "")


def baseline_of(results: StudyResults, name: str, reward: str, soc_min: float) -> Baseline | None:
    """A baseline; None where it was not driven."""
    try:
        return results.baseline(name, reward, soc_min)
    except KeyError:
        return None


def scores_of(results: StudyResults, key: str) -> FloatArray | None:
    """Share of the way from random feasible (0) to the exact optimum of the row's reward (1),
    shape (S,); None where a run or a reference is missing."""
    runs = results.of(key)
    ends = _ends(results, runs[0].row.reward, runs[0].row.soc_min) if runs else None
    if ends is None:
        return None
    return (values_of(results, key, lambda o: o.reward_sum) - ends[0]) / (ends[1] - ends[0])


def baseline_score(results: StudyResults, name: str, reward: str, soc_min: float) -> float | None:
    """The same of a drive that does not learn."""
    found, ends = baseline_of(results, name, reward, soc_min), _ends(results, reward, soc_min)
    if found is None or ends is None:
        return None
    return (found.outcome.reward_sum - ends[0]) / (ends[1] - ends[0])


def _ends(results: StudyResults, reward: str, soc_min: float) -> tuple[float, float] | None:
    floor = baseline_of(results, "random_feasible", reward, soc_min)
    top = baseline_of(results, "optimum", reward, soc_min)
    if floor is None or top is None:
        return None
    low, high = floor.outcome.reward_sum, top.outcome.reward_sum
    return (low, high) if low < high else None
