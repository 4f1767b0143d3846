"""Judges of claims about final drives and tables: fuel, efficiency, SOC, visits, correlation."""

from collections.abc import Sequence

import numpy as np

from tractor_ems.study.convergence import MIN_SEEDS
from tractor_ems.study.names import BASELINE_NAMES, names_within
from tractor_ems.study.paper_values import (
    PEARSON,
    PERCENTAGES,
    SETTINGS,
    SUMMARY,
    episodes_text,
    percent_text,
)
from tractor_ems.study.results import Outcome, StudyResults
from tractor_ems.study.speed_claims import SAME_FUEL, SAME_SOC
from tractor_ems.study.statistics import (
    iqm_interval,
    probability_of_improvement,
    ratio_interval,
    strength_of,
)
from tractor_ems.study.verdicts import (
    OPEN,
    Found,
    Verdict,
    above,
    all_hold,
    baseline_of,
    baseline_score,
    below,
    defined_of,
    dp_ratio_text,
    iqm_text,
    join,
    rng,
    scores_of,
    unresolved,
    values_of,
    within,
)
from tractor_sim.fuel import gallons

CALIBRATED = 0.02
"""A row that the plant was calibrated on agrees within this."""

NEAR_DP_FUEL = 0.965
"""Least DP fuel over run fuel that rounds to the paper's 97 %."""

NEAR_DP_EFFICIENCY = 0.98
"""Least efficiency over DP's; the paper prints 98.4 and 98.6 % for the same 43 %."""

EFFICIENT = PERCENTAGES.best_efficiency[0]
"""Lower end of what the paper calls the efficient region, 42-44 %."""

LOW_EFFICIENCY = 0.255
"""Efficiency from which the printed "20-25 %" is exceeded, rounding included."""

PREDOMINANT = 0.5
"""Share that "predominantly" and "the majority" need."""

SOLVED = 0.95
"""Share of the way from random feasible to the exact optimum of its reward that a suitable agent
reaches: the 95 % of the convergence rule."""


def same_fuel(results: StudyResults, keys: Sequence[str]) -> Found:
    """Two rows burn the same."""
    first, second = (values_of(results, key, lambda o: o.fuel_kg) for key in keys)
    if second.min() <= 0.0:
        return unresolved("a seed burnt nothing, which has no ratio")
    ratio = ratio_interval(first, second, rng())
    more = probability_of_improvement(first, second, rng())
    names = names_within(keys)
    fuels = [
        f"{names[key]} {iqm_text(np.array([gallons(v) for v in values]))} gal"
        for key, values in zip(keys, (first, second), strict=True)
    ]
    socs = [iqm_text(values_of(results, key, lambda o: o.soc_final)) for key in keys]
    return within(ratio, 1.0, SAME_FUEL), join(
        ", ".join(fuels),
        f"ratio {ratio.text()}, the same within {percent_text(SAME_FUEL, 0)}",
        f"the first burns more with probability {more.text(2)}",
        f"final SOC {', '.join(socs)}",
    )


def low_power(results: StudyResults, keys: Sequence[str]) -> Found:
    """The engine runs below 60 kW most of its time, at 25 % or less."""
    verdicts: list[Verdict] = []
    numbers = []
    names = names_within(keys)
    for key in keys:
        shares = defined_of(results, key, lambda o: o.below_60kw_share)
        efficiencies = defined_of(results, key, lambda o: o.efficiency)
        if min(len(shares), len(efficiencies)) < MIN_SEEDS:
            verdicts.append(OPEN)
            numbers.append(
                f"{names[key]}: the engine ran in {len(shares)} seeds, {MIN_SEEDS} are needed"
            )
            continue
        share, efficiency = iqm_interval(shares, rng()), iqm_interval(efficiencies, rng())
        verdicts += [above(share, PREDOMINANT), below(efficiency, LOW_EFFICIENCY)]
        numbers.append(
            f"{names[key]}: {share.text(2)} of the running time below 60 kW, "
            f"efficiency {efficiency.text()}"
        )
    return all_hold(verdicts), join(*numbers)


def efficient(results: StudyResults, keys: Sequence[str]) -> Found:
    """The engine works in the efficient region."""
    values = defined_of(results, keys[0], lambda o: o.efficiency)
    if len(values) < MIN_SEEDS:
        return unresolved(f"the engine ran in {len(values)} seeds, {MIN_SEEDS} are needed")
    efficiency = iqm_interval(values, rng())
    inside = defined_of(results, keys[0], _share_in_region)
    plain = defined_of(results, "ddqn@0.7", lambda o: o.efficiency)
    return above(efficiency, EFFICIENT), join(
        f"efficiency {efficiency.text()}, {percent_text(EFFICIENT, 0)} or more is asked, "
        "the paper has 43 %",
        f"{iqm_text(inside, 2)} of the running time at 110-190 kW",
        f"without shaping {iqm_text(plain)}",
    )


def near_dp(results: StudyResults, keys: Sequence[str]) -> Found:
    """DP's fuel and efficiency are nearly reached at DP's final SOC, counted as the paper does;
    beside it the matched-SOC ratio, and drives that learnt nothing."""
    row = results.of(keys[0])[0].row
    dp = baseline_of(results, "dp", row.reward, row.soc_min)
    efficiencies = defined_of(results, keys[0], lambda o: o.efficiency)
    if dp is None or dp.outcome.efficiency is None or len(efficiencies) < MIN_SEEDS:
        return unresolved("no DP drive, or an engine that never ran, to compare with")
    best = dp.outcome
    fuels = values_of(results, keys[0], lambda o: o.fuel_kg)
    if fuels.min() <= 0.0:
        return unresolved("a seed burnt nothing, which is no fraction of DP's fuel")
    fuel = iqm_interval(best.fuel_kg / fuels, rng())
    efficiency = iqm_interval(np.array(efficiencies) / dp.outcome.efficiency, rng())
    socs = values_of(results, keys[0], lambda o: o.soc_final)
    gap = iqm_interval(socs - best.soc_final, rng())
    verdict = all_hold(
        [
            above(fuel, NEAR_DP_FUEL),
            above(efficiency, NEAR_DP_EFFICIENCY),
            within(gap, 0.0, SAME_SOC),
        ]
    )
    others = []
    for name in ("best_point", "myopic", "rule_based"):
        other = baseline_of(results, name, row.reward, row.soc_min)
        if other is None:
            others.append(f"{BASELINE_NAMES[name]} not driven")
        else:
            others.append(f"{BASELINE_NAMES[name]} {_without_learning(other.outcome, best)}")
    return verdict, join(
        f"DP fuel / fuel {fuel.text()}, efficiency / DP's {efficiency.text()}",
        f"final SOC minus DP's {gap.text(4)}, the same within {SAME_SOC}",
        f"matched-SOC dp_ratio {dp_ratio_text(results, keys[0])}",
        "without learning: " + ", ".join(others),
    )


def tabular_unsuitable(results: StudyResults, keys: Sequence[str]) -> Found:
    """After the paper's episodes most pairs are unvisited and the drive is short of the optimum
    of its reward. Beside it what looking at the next reward alone reaches: a score near that
    shows no learning."""
    key = keys[0]
    row = results.of(key)[0].row
    tables = [run.table for run in results.of(key) if run.table is not None]
    scores = scores_of(results, key)
    if len(tables) < MIN_SEEDS or scores is None:
        return unresolved("no tables, or no reference drives to score with")
    unvisited = iqm_interval([1.0 - t.pairs_visited / t.pairs for t in tables], rng())
    feasible = iqm_interval(
        [1.0 - min(t.pairs_visited / t.pairs_feasible, 1.0) for t in tables], rng()
    )
    score = iqm_interval(scores, rng())
    myopic = baseline_of(results, "myopic", row.reward, row.soc_min)
    alone = baseline_score(results, "myopic", row.reward, row.soc_min)
    without = "myopic greedy not driven"
    if myopic is not None and alone is not None:
        place = "better than" if alone > score.high else "worse than"
        if score.low <= alone <= score.high:
            place = "no different from"
        ratio = myopic.outcome.dp_ratio
        without = (
            f"myopic greedy, which learns nothing, reaches {alone:.3f} of that way, "
            f"{place} this agent" + ("" if ratio is None else f", dp_ratio {ratio:.4f}")
        )
    numbers = (
        f"{episodes_text(results.episodes_tabular)} episodes",
        f"{unvisited.text()} of the pairs never visited, {feasible.text()} of the feasible ones "
        f"({percent_text(PREDOMINANT, 0)} of all is asked)",
        f"{score.text()} of the way from random to the optimum of its reward "
        f"(suitable from {SOLVED})",
        without,
        f"final SOC {iqm_text(values_of(results, key, lambda o: o.soc_final))}",
        f"dp_ratio {dp_ratio_text(results, key)}",
    )
    verdict = all_hold([above(unvisited, PREDOMINANT), below(score, SOLVED)])
    if verdict == "holds" and results.episodes_tabular < SETTINGS.tabular_episodes:
        return unresolved(join("fewer episodes than the paper's 100,000", *numbers))
    return verdict, join(*numbers)


def weakly_negative(results: StudyResults, keys: Sequence[str]) -> Found:
    """The correlation between Q and reward has the paper's strength and sign."""
    found = [run.table.pearson for run in results.of(keys[0]) if run.table is not None]
    values = [value for value in found if value is not None]
    if len(values) < MIN_SEEDS:
        return unresolved(f"defined in {len(values)} seeds, {MIN_SEEDS} are needed")
    r = iqm_interval(values, rng())
    numbers = f"{r.text()}, a {strength_of(r.value)}; the paper has {PEARSON}"
    if results.episodes_tabular < SETTINGS.tabular_episodes:
        return unresolved(join("fewer episodes than the paper's 100,000", numbers))
    ends, wanted = {strength_of(r.low), strength_of(r.high)}, strength_of(PEARSON)
    if ends == {wanted}:
        return "holds", numbers
    if wanted not in ends and r.low * r.high > 0.0:  # wholly on one side of the weak range
        return "does not hold", numbers
    return unresolved(numbers)


def calibrated(results: StudyResults, name: str) -> Found:
    """Conventional or DP agrees with the row that the plant was tuned to."""
    printed = next(item for item in SUMMARY if item.id == name)
    here = baseline_of(results, name, "fuel", 0.70)
    if here is None or here.outcome.efficiency is None:
        return unresolved("not driven")
    outcome, efficiency = here.outcome, here.outcome.efficiency
    gaps = [
        gallons(outcome.fuel_kg) / printed.fuel_gal - 1.0,
        efficiency / printed.efficiency[0] - 1.0,
    ]
    if printed.soc_final is not None:
        gaps.append(outcome.soc_final / printed.soc_final - 1.0)
    worst = max(gaps, key=abs)
    return ("calibrated" if abs(worst) <= CALIBRATED else "does not hold"), join(
        f"{gallons(outcome.fuel_kg):.3f} gal, {percent_text(efficiency, 2)}, "
        f"final SOC {percent_text(outcome.soc_final, 2)}",
        f"largest difference {percent_text(worst)}, allowed {percent_text(CALIBRATED, 0)}",
    )


def _share_in_region(outcome: Outcome) -> float | None:
    running = outcome.trajectory.engine_power_w[outcome.trajectory.engine_on]
    if len(running) == 0:
        return None
    low, high = SETTINGS.efficient_from_w, SETTINGS.efficient_to_w
    return float(np.mean((running >= low) & (running <= high)))


def _without_learning(outcome: Outcome, best: Outcome) -> str:
    share = f"{best.fuel_kg / outcome.fuel_kg:.3f}" if outcome.fuel_kg > 0.0 else "no fuel"
    ratio = "none" if outcome.dp_ratio is None else f"{outcome.dp_ratio:.4f}"
    return f"{share} (dp_ratio {ratio}, final SOC {outcome.soc_final:.3f})"
