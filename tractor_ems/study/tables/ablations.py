"""What changes to a row of the paper do, and what the tables' own ablation says: is it aliasing
between SOC bins or the size of the table that keeps a tabular agent from the optimum?"""

from collections.abc import Sequence
from dataclasses import asdict

from tractor_ems.study.convergence import MIN_SEEDS
from tractor_ems.study.drive_claims import SOLVED
from tractor_ems.study.results import Run, StudyResults
from tractor_ems.study.rows import Row
from tractor_ems.study.statistics import difference_interval, iqm_interval
from tractor_ems.study.tables.measures import (
    ABLATIONS,
    ALSO_AGAINST,
    NOT_RUN,
    episodes_to_convergence,
    episodes_to_optimum,
    fuel_gal,
    measure,
    measure_values,
    row_name,
    soc_min_of,
    soc_min_text,
)
from tractor_ems.study.tables.quantities import NONE, measure_text
from tractor_ems.study.tables.reasons import way_to_optimum
from tractor_ems.study.tables.table import Table
from tractor_ems.study.verdicts import rng, scores_of

TABLE, INTERPOLATED = "double_q@0.7", "double_q_interpolated@0.7"

_NAMES = {
    "algorithm": "algorithm",
    "reward": "reward",
    "soc_min": "SOC_min",
    "mapping": "action mapping",
    "actions": "actions",
    "soc_bins": "SOC bins",
    "interpolate": "interpolation",
    "epsilon_start": "epsilon at the start",
    "seeding": "seeding",
    "replay": "seeds in the replay",
    "margin": "margin",
    "target_every": "target every",
    "target_rate": "target rate",
}
"""Every setting of a row but its names; one that is missing here keeps the name in code."""


def ablations_table(results: StudyResults) -> Table:
    """Rows of the paper, each followed by ours with every setting that differs."""
    rows = []
    for base_key, changed in ABLATIONS:
        for key in (base_key, *changed):
            bold = key == base_key
            name = f"**{row_name(key)}**" if bold else row_name(key)
            runs = results.of(key)
            if not runs:
                rows.append((name, soc_min_text(soc_min_of(key)), *[NOT_RUN] * 8))
                continue
            against = () if bold else (base_key, ALSO_AGAINST.get(key))
            change = "; ".join(_against(results, other, runs) for other in against if other)
            rows.append(
                (
                    name,
                    soc_min_text(runs[0].row.soc_min),
                    change or "row of the paper",
                    *_cells(results, runs),
                )
            )
    return Table(
        "ablations",
        "Ablations",
        "Each block: a row of the paper (bold), then rows of ours with the row that each is "
        "compared with and **every** setting in which the two differ; some change several at "
        "once, and then no one of them is to thank or to blame. Run at the SOC_min shown only. "
        f"The last column: episodes until the greedy return stays at {100 * SOLVED:.0f} % of the "
        "way from random feasible to the exact optimum of the reward, where `episodes` asks only "
        "that the curve has settled.",
        (
            "row",
            "SOC_min",
            "against, and what differs",
            "dp_ratio",
            "way to the reward's optimum",
            "fuel [gal]",
            "efficiency",
            "final SOC",
            "episodes",
            "episodes to 95 % of the optimum",
        ),
        tuple(rows),
        (aliasing_or_size(results),),
    )


def aliasing_or_size(results: StudyResults) -> str:
    """Our question about tabular double Q, answered from the same table with and without
    interpolation between SOC bins. Rule: aliasing counts where interpolation raises the share of
    the way to the optimum (95 % interval of the difference above 0); what then is missing to 95 %
    of the way is left to the size of the table and the budget."""
    question = "**Aliasing or table size?** (our question, tabular double Q) "
    before, after = scores_of(results, TABLE), scores_of(results, INTERPOLATED)
    if before is None or after is None:
        return question + "Not resolved: a row or a reference drive was not run."
    gain = difference_interval(after, before, rng())
    first, second = (
        measure_text(measure_values(list(map(float, values))), True, 100.0, 1, " %")
        for values in (before, after)
    )
    unvisited = [_unvisited(results.of(key)) for key in (TABLE, INTERPOLATED)]
    numbers = (
        f"Interpolating between SOC bins takes the way from random to the optimum from {first} "
        f"to {second}, a difference of {100 * gain.value:+.1f} points [{100 * gain.low:+.1f}, "
        f"{100 * gain.high:+.1f}]; feasible pairs never visited {unvisited[0]} and "
        f"{unvisited[1]} (an interpolated step updates two bins). "
    )
    if gain.runs < MIN_SEEDS:
        return question + numbers + f"Not resolved: {gain.runs} seeds, {MIN_SEEDS} are needed."
    left = SOLVED - iqm_interval(after, rng()).value
    if gain.low > 0.0:
        answer = "Aliasing between SOC bins is part of it"
        answer += (
            "; the rest, to "
            f"{100 * SOLVED:.0f} % of the way, is left to the number of pairs and the budget."
            if left > 0.0
            else " and enough to explain it: what is left is small."
        )
    elif gain.high < 0.0:
        answer = (
            "Aliasing is not what holds the table back: without it the agent is worse. What is "
            "missing is left to the number of pairs and the budget."
        )
    else:
        answer = (
            "Not resolved: the interval of the difference includes 0, so aliasing is not shown "
            "to matter, nor shown not to."
        )
    return question + numbers + answer


def changes(base: Row, row: Row) -> str:
    """Every setting in which two rows differ, names and label aside."""
    before, after = asdict(base), asdict(row)
    return (
        "; ".join(
            f"{_NAMES.get(field, field)}: {_setting(field, before[field])} to "
            f"{_setting(field, after[field])}"
            for field in before
            if field not in ("id", "label", "role") and before[field] != after[field]
        )
        or "nothing"
    )


def _against(results: StudyResults, key: str, runs: Sequence[Run]) -> str:
    base = results.of(key)
    what = changes(base[0].row, runs[0].row) if base else NOT_RUN
    return f"against {row_name(key)}: {what}"


def _cells(results: StudyResults, runs: Sequence[Run]) -> tuple[str, ...]:
    way = measure_values([way_to_optimum(results, run) for run in runs])
    settled, solved = episodes_to_convergence(runs), episodes_to_optimum(results, runs)
    return (
        measure_text(measure(runs, lambda o: o.dp_ratio), True, 1.0, 4, ""),
        measure_text(way, True, 100.0, 1, " %"),
        measure_text(measure(runs, fuel_gal), True, 1.0, 3, ""),
        measure_text(measure(runs, lambda o: o.efficiency), True, 100.0, 1, " %"),
        measure_text(measure(runs, lambda o: o.soc_final), True, 100.0, 1, " %"),
        NONE if settled is None else settled.text,
        NONE if solved is None else solved.text,
    )


def _unvisited(runs: Sequence[Run]) -> str:
    tables = [run.table for run in runs if run.table is not None]
    shares = [1.0 - min(t.pairs_visited / max(t.pairs_feasible, 1), 1.0) for t in tables]
    return measure_text(measure_values(shares), True, 100.0, 1, " %")


def _setting(field: str, value: object) -> str:
    if value is None:
        return "continuous"
    if isinstance(value, bool):
        return "on" if value else "off"
    if field == "soc_min" and isinstance(value, float):
        return soc_min_text(value)
    return f"{value:g}" if isinstance(value, float) else str(value)
