"""Why a row differs from the paper, read off the runs: budget, convergence, the optimum of its
reward, SOC_min. Never a guess that the data do not show."""

from tractor_ems.study.paper_values import SETTINGS, episodes_text
from tractor_ems.study.results import Run, StudyResults
from tractor_ems.study.tables.measures import (
    NOT_RUN,
    episodes_to_convergence,
    find_baseline,
    fuel_gal,
    measure_values,
    soc_min_text,
)
from tractor_ems.study.tables.quantities import LARGE, Entry, percent_text

SAME_SOC = 0.005
"""Final SOC is the same within this."""


def way_to_optimum(results: StudyResults, run: Run) -> float | None:
    """Where the return of a run's final drive lies between that of random feasible, 0, and of the
    exact optimum of its reward, 1; None where the study has no such references."""
    reward, soc_min = run.row.reward, run.row.soc_min
    low = find_baseline(results, "random_feasible", reward, soc_min)
    high = find_baseline(results, "optimum", reward, soc_min)
    if low is None or high is None:
        return None
    span = high.outcome.reward_sum - low.outcome.reward_sum
    return None if span <= 0.0 else (run.outcome.reward_sum - low.outcome.reward_sum) / span


def reason(results: StudyResults, entry: Entry, *, drive: bool, episodes: bool) -> str:
    """Why this entry differs by more than 2 % from the paper.

    Args:
        drive: fuel, efficiency, SOC or what is counted from them differs.
        episodes: episodes until convergence differ.
    """
    if not entry.outcomes:
        return NOT_RUN
    if not entry.learner:
        return f"calibration is off by more than {percent_text(LARGE, 0)}"
    parts = [_budget(results, entry)]
    if drive:
        parts += [_learned(results, entry), _soc(entry)]
    if episodes:
        parts.append(_speed(entry))
    if len(entry.runs) < 2:
        parts.append("one seed")
    return "; ".join(part for part in parts if part)


def _budget(results: StudyResults, entry: Entry) -> str:
    done = max(run.episodes for run in entry.runs)
    paper = entry.printed.episodes
    if paper is None and entry.runs[0].row.tabular:
        paper = SETTINGS.tabular_episodes
    text = f"budget {episodes_text(done)} episodes"
    if paper is not None:
        text = f"budget {episodes_text(done)} of the paper's {episodes_text(paper)} episodes"
    ratio = results.steps_per_update
    if ratio > 1 and not entry.runs[0].row.tabular:
        text += f", one update per {ratio} steps"
    return text


def _learned(results: StudyResults, entry: Entry) -> str:
    """What the reward asks for, and how near to it the learner came: which of them is to blame."""
    found = measure_values([way_to_optimum(results, run) for run in entry.runs])
    best = find_baseline(results, "optimum", entry.reward, entry.soc_min)
    if found is None or best is None:
        return "no exact optimum to tell the learner from its reward"
    return (
        f"{percent_text(found.interval.value, 0)} of the way from random to the exact optimum of "
        f"its reward, which is {fuel_gal(best.outcome):.2f} gal and final SOC "
        f"{percent_text(best.outcome.soc_final)}"
    )


def _soc(entry: Entry) -> str:
    paper = entry.printed.soc_final
    found = measure_values([outcome.soc_final for outcome in entry.outcomes])
    if paper is None or found is None or abs(found.interval.value - paper) <= SAME_SOC:
        return ""
    return (
        f"with SOC_min {soc_min_text(entry.soc_min)} it ends at "
        f"{percent_text(found.interval.value)}, not {percent_text(paper)}: fuels at different "
        "final SOC cannot be compared"
    )


def _speed(entry: Entry) -> str:
    found = episodes_to_convergence(entry.runs)
    if found is None:
        return ""
    if found.censored:
        why = sorted({run.reason for run in found.runs if run.reason})
        return f"{found.censored} of {len(found.runs)} seeds not converged ({', '.join(why)})"
    return "convergence by this study's rule and exploration schedule, the paper states neither"
