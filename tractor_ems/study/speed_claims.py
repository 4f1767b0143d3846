"""Judges of claims about convergence speed. Censored curves leave such a claim open."""

from collections.abc import Sequence

from tractor_ems.study.convergence import (
    Convergence,
    SpeedComparison,
    compare_speed,
    converged,
    convergence_over_seeds,
)
from tractor_ems.study.names import names_within, row_name
from tractor_ems.study.paper_values import percent_text
from tractor_ems.study.results import StudyResults
from tractor_ems.study.statistics import difference_interval, ratio_interval
from tractor_ems.study.verdicts import (
    OPEN,
    Found,
    Verdict,
    all_hold,
    baseline_score,
    dp_ratio_text,
    iqm_text,
    join,
    rng,
    scores_of,
    unresolved,
    values_of,
    within,
)

SAME_FUEL = 0.02
"""Two fuels are the same within this: the margin of calibration; 0.34 gal is printed to 1.5 %."""

SAME_SOC = 0.005
"""Final SOC is the same within this; the paper calls 83.6 and 83.7 % the same."""


def faster(results: StudyResults, keys: Sequence[str], printed: float) -> Found:
    """The first row converges sooner than the second; ``printed`` is the paper's share fewer."""
    comparison, numbers = _compare(results, keys[0], keys[1])
    verdict, why = _decided(comparison)
    size = ""
    if verdict == "holds":
        inside = comparison.saving.low <= printed <= comparison.saving.high
        place = "inside" if inside else "outside"
        size = f"the paper's {percent_text(printed)} is {place} the interval"
    return verdict, join(why, numbers, size, _epsilon_note(results, keys))


def lies_between(results: StudyResults, keys: Sequence[str]) -> Found:
    """The first row converges sooner than the second, and the second sooner than the third."""
    pairs = [_compare(results, *keys[:2]), _compare(results, *keys[1:])]
    decided = [_decided(comparison) for comparison, _ in pairs]
    verdict = all_hold(verdict for verdict, _ in decided)
    return verdict, join(*(why for _, why in decided), *(numbers for _, numbers in pairs))


def all_converge(results: StudyResults, keys: Sequence[str]) -> Found:
    """Every seed of every row converges; a budget that ends first proves nothing."""
    rows = {key: convergences(results, key) for key in keys}
    names = names_within(keys)
    numbers = ", ".join(
        f"{names[key]} {convergence_over_seeds(runs, rng()).text}" for key, runs in rows.items()
    )
    reasons = {run.reason for runs in rows.values() for run in runs if run.episodes is None}
    if reasons:
        return unresolved(join(*sorted(reasons), numbers))
    return "holds", join(numbers, *(_settled_where(results, key) for key in keys))


def _settled_where(results: StudyResults, key: str) -> str:
    """A settled curve need not be a good one."""
    scores = scores_of(results, key)
    if scores is None:
        return ""
    row = results.of(key)[0].row
    alone = baseline_score(results, "myopic", row.reward, row.soc_min)
    beside = "" if alone is None else f" (myopic greedy, which learns nothing: {alone:.3f})"
    return (
        f"{row_name(key)} settles at {iqm_text(scores)} of the way from random to the optimum "
        f"of its reward{beside}, dp_ratio {dp_ratio_text(results, key)}"
    )


def speed_not_optimality(results: StudyResults, keys: Sequence[str]) -> Found:
    """The best and the worst seeds (second and last row) differ in speed, either way, while every
    row's fuel and final SOC are those of the first. One comparison: the best of several pairs
    would differ by chance more often than 5 %."""
    comparison, numbers = _compare(results, keys[1], keys[-1])
    resolved, why = _decided(comparison)
    names = names_within(keys)
    fuels = {key: values_of(results, key, lambda o: o.fuel_kg) for key in keys}
    if min(values.min() for values in fuels.values()) <= 0.0:
        return unresolved("a seed burnt nothing, which has no ratio")
    ratios = {key: ratio_interval(fuels[key], fuels[keys[0]], rng()) for key in keys[1:]}
    socs = {key: values_of(results, key, lambda o: o.soc_final) for key in keys}
    gaps = {key: difference_interval(socs[key], socs[keys[0]], rng()) for key in keys[1:]}
    same_fuel = all_hold(within(ratio, 1.0, SAME_FUEL) for ratio in ratios.values())
    same_soc = all_hold(within(gap, 0.0, SAME_SOC) for gap in gaps.values())
    # Fuel at different final SOC says nothing about optimality, either way.
    optimality = same_fuel if same_soc == "holds" else OPEN
    speed: Verdict = OPEN if resolved == OPEN else "holds"
    return all_hold([speed, optimality]), join(
        why,
        numbers,
        f"fuel over that of {names[keys[0]]}: "
        + ", ".join(f"{names[key]} {ratio.text()}" for key, ratio in ratios.items())
        + f" (the same within {percent_text(SAME_FUEL, 0)}: {same_fuel})",
        "final SOC minus its: "
        + ", ".join(f"{names[key]} {gap.text(4)}" for key, gap in gaps.items())
        + f" (the same within {SAME_SOC}: {same_soc})",
        "dp_ratio " + ", ".join(f"{names[key]} {dp_ratio_text(results, key)}" for key in keys),
    )


def convergences(results: StudyResults, key: str) -> list[Convergence]:
    """Every run of a row under the rule."""
    return [converged(run.curve.episode, run.curve.eval_return) for run in results.of(key)]


def _compare(results: StudyResults, first: str, second: str) -> tuple[SpeedComparison, str]:
    rows = {key: convergences(results, key) for key in (first, second)}
    comparison = compare_speed(rows[first], rows[second], rng())
    texts = [
        f"{row_name(key)} {convergence_over_seeds(runs, rng()).text}" for key, runs in rows.items()
    ]
    saving = comparison.saving
    return comparison, (
        f"episodes {', '.join(texts)}: {percent_text(saving.value)} fewer "
        f"[{percent_text(saving.low)}, {percent_text(saving.high)}], sooner with probability "
        f"{comparison.sooner.text(2)}"
    )


def _decided(comparison: SpeedComparison) -> Found:
    if any(comparison.censored):
        first, second = comparison.censored
        return unresolved(
            f"{first} and {second} seeds did not converge within the budget "
            f"(sooner, as far as it goes: {comparison.verdict})"
        )
    if comparison.verdict == "not resolved":
        return unresolved(comparison.reason)
    return ("holds" if comparison.verdict == "yes" else "does not hold"), ""


def _epsilon_note(results: StudyResults, keys: Sequence[str]) -> str:
    starts = [results.of(key)[0].row.epsilon_start for key in keys]
    if len(set(starts)) == 1:
        return ""
    return f"epsilon differs too, as in the paper ({starts[0]:g} and {starts[1]:g})"
