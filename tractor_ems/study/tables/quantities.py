"""What the paper prints about a method and what this study measured: one definition per quantity
of how it reads, how it differs, and when the difference needs a reason."""

from collections.abc import Callable
from dataclasses import dataclass

from tractor_ems.study.convergence import RowConvergence
from tractor_ems.study.paper_values import MethodValue, episodes_text
from tractor_ems.study.results import Baseline, Outcome, Run, StudyResults
from tractor_ems.study.tables.measures import (
    NOT_RUN,
    Measure,
    episodes_to_convergence,
    find_baseline,
    fuel_gal,
    measure_values,
)

LARGE = 0.02
"""Relative difference from the paper above which a row needs a reason."""

NONE = "-"


@dataclass(frozen=True)
class Printed:
    """What the paper prints about one method; None where it prints nothing.

    Attributes:
        fuel_gal, soc_final, reduction, fuel_of_dp, efficiency_of_dp: as in ``MethodValue``.
        efficiency: lowest and highest.
        episodes: until convergence.
    """

    fuel_gal: float | None = None
    efficiency: tuple[float, float] | None = None
    soc_final: float | None = None
    episodes: int | None = None
    reduction: float | None = None
    fuel_of_dp: float | None = None
    efficiency_of_dp: float | None = None

    @classmethod
    def of(cls, value: MethodValue) -> "Printed":
        """The same numbers."""
        return cls(
            value.fuel_gal,
            value.efficiency,
            value.soc_final,
            value.episodes,
            value.reduction,
            value.fuel_of_dp,
            value.efficiency_of_dp,
        )


@dataclass(frozen=True)
class Entry:
    """One line of a comparison: a method of the paper and what re-makes it here.

    Attributes:
        label: for readers.
        soc_min: of the plant.
        runs: of a learner, empty for a baseline or where it was not run.
        baseline: of what does not learn, else None.
        learner: it is a learner, run or not.
        printed: by the paper.
    """

    label: str
    soc_min: float
    runs: tuple[Run, ...]
    baseline: Baseline | None
    learner: bool
    printed: Printed

    @property
    def outcomes(self) -> tuple[Outcome, ...]:
        """Final drives; empty where there are none."""
        if self.baseline is not None:
            return (self.baseline.outcome,)
        return tuple(run.outcome for run in self.runs)

    @property
    def reward(self) -> str:
        """That the drives were judged by."""
        if self.runs:
            return self.runs[0].row.reward
        return self.baseline.reward if self.baseline is not None else "fuel"


@dataclass(frozen=True)
class Compared:
    """Three cells, and whether the difference needs a reason."""

    paper: str
    here: str
    difference: str
    large: bool


@dataclass(frozen=True)
class Quantity:
    """A column group paper / here / difference.

    Attributes:
        name: heading, with unit.
        compare: cells of an entry.
    """

    name: str
    compare: Callable[[StudyResults, Entry], Compared]


def percent_text(value: float, digits: int = 1) -> str:
    """A fraction as ``43.0 %``."""
    return f"{100.0 * value:.{digits}f} %"


def measure_text(
    found: Measure | None, learner: bool, scale: float, digits: int, unit: str
) -> str:
    """``43.0 % [42.9, 43.1]``, ``43.0 % (1 run)``; a baseline has no interval."""
    if found is None:
        return NONE
    interval = found.interval
    text = f"{scale * interval.value:.{digits}f}{unit}"
    if learner:
        if interval.runs < 2:
            text += " (1 run)"
        else:
            low, high = scale * interval.low, scale * interval.high
            text += f" [{low:.{digits}f}, {high:.{digits}f}]"
        if found.missing:
            text += f", {found.missing} of {found.missing + len(found.values)} seeds none"
    return text


def signed(value: float, digits: int) -> str:
    """With its sign; what rounds to nothing is +0, never -0."""
    return f"{round(value, digits) + 0.0:+,.{digits}f}"


def relative(paper: float, here: float) -> float:
    """Difference over the paper's value; 0 where both are 0."""
    return 0.0 if here == paper else (here - paper) / paper


def _fuel(results: StudyResults, entry: Entry) -> Compared:
    found = measure_values([fuel_gal(outcome) for outcome in entry.outcomes])
    here = _here(entry, found, 1.0, 3, "")
    paper = entry.printed.fuel_gal
    if paper is None or found is None:
        return Compared(NONE if paper is None else f"{paper:.2f}", here, NONE, False)
    gap = relative(paper, found.interval.value)
    text = f"{signed(found.interval.value - paper, 3)} ({signed(100 * gap, 1)} %)"
    return Compared(f"{paper:.2f}", here, text, abs(gap) > LARGE)


def _fuel_kg(results: StudyResults, entry: Entry) -> Compared:
    found = measure_values([outcome.fuel_kg for outcome in entry.outcomes])
    return Compared(NONE, _here(entry, found, 1.0, 3, ""), NONE, False)


def _efficiency(results: StudyResults, entry: Entry) -> Compared:
    found = measure_values([outcome.efficiency for outcome in entry.outcomes])
    here = _here(entry, found, 100.0, 2, " %")
    printed = entry.printed.efficiency
    if printed is None:
        return Compared(NONE, here, NONE, False)
    low, high = printed
    paper = f"{100 * low:g} %" if low == high else f"{100 * low:g}-{100 * high:g} %"
    if found is None:
        return Compared(paper, here, NONE, False)
    value = found.interval.value
    nearest = min(max(value, low), high)
    gap = relative(nearest, value)
    text = "within" if low < high and gap == 0.0 else _points(value - nearest, gap, 2)
    return Compared(paper, here, text, abs(gap) > LARGE)


def _soc_final(results: StudyResults, entry: Entry) -> Compared:
    found = measure_values([outcome.soc_final for outcome in entry.outcomes])
    here = _here(entry, found, 100.0, 1, " %")
    paper = entry.printed.soc_final
    if paper is None or found is None:
        return Compared(NONE if paper is None else percent_text(paper), here, NONE, False)
    gap = relative(paper, found.interval.value)
    text = _points(found.interval.value - paper, gap)
    return Compared(percent_text(paper), here, text, abs(gap) > LARGE)


def _percentage(
    get: Callable[[StudyResults, Entry, Outcome], float | None],
    printed: Callable[[Printed], float | None],
) -> Callable[[StudyResults, Entry], Compared]:
    """What is a percentage of another drive already differs in points."""

    def compare(results: StudyResults, entry: Entry) -> Compared:
        found = measure_values([get(results, entry, outcome) for outcome in entry.outcomes])
        here = _here(entry, found, 100.0, 1, " %")
        paper = printed(entry.printed)
        if paper is None or found is None:
            return Compared(NONE if paper is None else percent_text(paper), here, NONE, False)
        gap = found.interval.value - paper
        text = f"{signed(100 * gap, 1)} points"
        return Compared(percent_text(paper), here, text, abs(gap) > LARGE)

    return compare


def _episodes(results: StudyResults, entry: Entry) -> Compared:
    paper = entry.printed.episodes
    shown = NONE if paper is None else episodes_text(paper)
    found = episodes_to_convergence(entry.runs)
    if found is None:
        return Compared(shown, NOT_RUN if entry.learner else NONE, NONE, False)
    if paper is None:
        return Compared(shown, found.text, NONE, False)
    difference, large = _episode_gap(found, paper)
    return Compared(shown, found.text, difference, large)


def _episode_gap(found: RowConvergence, paper: int) -> tuple[str, bool]:
    gap = relative(paper, found.episodes.value)
    if not found.lower_bound:
        return f"{signed(found.episodes.value - paper, 0)} ({signed(100 * gap, 1)} %)", abs(
            gap
        ) > LARGE
    if gap > 0.0:
        return f"more than {signed(100 * gap, 1)} %", gap > LARGE
    return "not known (censored)", True


def _dp(results: StudyResults, entry: Entry) -> Outcome | None:
    found = find_baseline(results, "dp", entry.reward, entry.soc_min)
    return None if found is None else found.outcome


def _reduction(results: StudyResults, entry: Entry, outcome: Outcome) -> float | None:
    found = find_baseline(results, "conventional", entry.reward, entry.soc_min)
    if found is None or outcome is found.outcome:
        return None
    return 1.0 - outcome.fuel_kg / found.outcome.fuel_kg


def _fuel_of_dp(results: StudyResults, entry: Entry, outcome: Outcome) -> float | None:
    """The paper's way: DP's fuel over the method's, whatever SOC either ends at."""
    best = _dp(results, entry)
    return None if best is None or outcome.fuel_kg <= 0.0 else best.fuel_kg / outcome.fuel_kg


def _efficiency_of_dp(results: StudyResults, entry: Entry, outcome: Outcome) -> float | None:
    best = _dp(results, entry)
    if best is None or best.efficiency is None or outcome.efficiency is None:
        return None
    return outcome.efficiency / best.efficiency


def _dp_ratio(results: StudyResults, entry: Entry) -> Compared:
    found = measure_values([outcome.dp_ratio for outcome in entry.outcomes])
    return Compared(NONE, _here(entry, found, 1.0, 4, ""), NONE, False)


def _here(entry: Entry, found: Measure | None, scale: float, digits: int, unit: str) -> str:
    if not entry.outcomes:
        return NOT_RUN
    return measure_text(found, entry.learner, scale, digits, unit)


def _points(difference: float, gap: float, digits: int = 1) -> str:
    return f"{signed(100 * difference, digits)} points ({signed(100 * gap, 1)} %)"


FUEL = Quantity("fuel [gal]", _fuel)
FUEL_KG = Quantity("fuel [kg]", _fuel_kg)
EFFICIENCY = Quantity("efficiency", _efficiency)
SOC_FINAL = Quantity("final SOC", _soc_final)
EPISODES = Quantity("episodes", _episodes)
REDUCTION = Quantity("less fuel than conventional", _percentage(_reduction, lambda p: p.reduction))
FUEL_OF_DP = Quantity("fuel, % of DP achieved", _percentage(_fuel_of_dp, lambda p: p.fuel_of_dp))
EFFICIENCY_OF_DP = Quantity(
    "efficiency, % of DP achieved", _percentage(_efficiency_of_dp, lambda p: p.efficiency_of_dp)
)
DP_RATIO = Quantity("dp_ratio, matched SOC", _dp_ratio)
