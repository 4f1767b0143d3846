"""Tables that the paper does not have: baselines beside every learner, the true optimum of each
reward, ablations, cost, differences from the paper, claims and slips."""

from collections.abc import Callable, Sequence
from dataclasses import asdict

import numpy as np

from tractor_ems.study.claims import claims
from tractor_ems.study.paper_values import SUMMARY
from tractor_ems.study.results import Outcome, Run, StudyResults
from tractor_ems.study.rows import Row
from tractor_ems.study.slips import slips
from tractor_ems.study.tables.measures import (
    ABLATIONS,
    BASELINE_NAMES,
    NOT_RUN,
    REWARD_NAMES,
    Measure,
    episodes_to_convergence,
    find_baseline,
    fuel_gal,
    measure,
    measure_values,
    row_name,
    soc_min_of,
)
from tractor_ems.study.tables.quantities import NONE, measure_text, percent_text, signed
from tractor_ems.study.tables.reasons import way_to_optimum
from tractor_ems.study.tables.table import Table


def our_tables(results: StudyResults) -> tuple[Table, ...]:
    """All of them, in the order of the report."""
    return (
        *_beside(results),
        _optimum(results),
        _ablations(results),
        _cost(results),
        _differences(results),
        claims_table(results),
        slips_table(),
    )


def _beside(results: StudyResults) -> tuple[Table, ...]:
    """Per reward and SOC_min: what does not learn, then every learner."""
    settings = dict.fromkeys((item.reward, item.soc_min) for item in results.baselines)
    settings |= dict.fromkeys((row.reward, row.soc_min) for row in results.rows)
    return tuple(_beside_one(results, reward, soc_min) for reward, soc_min in settings)


def _beside_one(results: StudyResults, reward: str, soc_min: float) -> Table:
    rows = []
    low = find_baseline(results, "random_feasible", reward, soc_min)
    high = find_baseline(results, "optimum", reward, soc_min)
    for name, shown in BASELINE_NAMES.items():
        found = find_baseline(results, name, reward, soc_min)
        if found is None:
            rows.append((shown, *[NOT_RUN] * 9))
            continue
        way = None
        if low is not None and high is not None:
            span = high.outcome.reward_sum - low.outcome.reward_sum
            if span > 0.0:
                way = (found.outcome.reward_sum - low.outcome.reward_sum) / span
        rows.append((shown, *_drive_cells((found.outcome,), False, measure_values([way]))))
    for row in results.rows:
        if row.reward == reward and abs(row.soc_min - soc_min) < 1e-9:
            runs = results.of(row.key)
            way_here = measure_values([way_to_optimum(results, run) for run in runs])
            outcomes = tuple(run.outcome for run in runs)
            rows.append((f"**{row.label}**", *_drive_cells(outcomes, True, way_here)))
    kind = _reward_name(reward)
    return Table(
        f"beside_{reward}_{soc_min:g}",
        f"Reward: {kind}; SOC_min {percent_text(soc_min)}",
        "Learners in bold. Return in the learner's units; `way` is 0 at random feasible and 100 % "
        "at the exact optimum of this reward. Fuel compares at equal final SOC only, which "
        "`dp_ratio` does.",
        (
            "drive",
            "return",
            "way",
            "fuel [gal]",
            "fuel [kg]",
            "efficiency",
            "final SOC",
            "running below 60 kW",
            "starts",
            "dp_ratio",
        ),
        tuple(rows),
    )


def _drive_cells(
    outcomes: Sequence[Outcome], learner: bool, way: Measure | None
) -> tuple[str, ...]:
    def cell(values: Sequence[float | None], scale: float, digits: int, unit: str = "") -> str:
        return measure_text(measure_values(values), learner, scale, digits, unit)

    return (
        cell([outcome.reward_sum for outcome in outcomes], 1.0, 1),
        measure_text(way, learner, 100.0, 1, " %"),
        cell([fuel_gal(outcome) for outcome in outcomes], 1.0, 3),
        cell([outcome.fuel_kg for outcome in outcomes], 1.0, 3),
        cell([outcome.efficiency for outcome in outcomes], 100.0, 1, " %"),
        cell([outcome.soc_final for outcome in outcomes], 100.0, 1, " %"),
        cell([outcome.below_60kw_share for outcome in outcomes], 100.0, 0, " %"),
        cell([float(outcome.engine_starts) for outcome in outcomes], 1.0, 0),
        cell([outcome.dp_ratio for outcome in outcomes], 1.0, 4),
    )


def _optimum(results: StudyResults) -> Table:
    """What each reward asks for, by exact DP on that reward, and how far above SOC_min it ends."""
    rows, ends = [], []
    unshaped, shaped = (
        next(item for item in SUMMARY if item.id == name) for name in ("ddqn", "ddqn_shaped")
    )
    for item in results.baselines:
        if item.id not in ("optimum", "myopic"):
            continue
        outcome = item.outcome
        printed = unshaped if item.reward == "fuel" else shaped
        assert printed.soc_final is not None
        fuel = fuel_gal(outcome)
        above = 100.0 * (outcome.soc_final - item.soc_min)
        rows.append(
            (
                f"{_reward_name(item.reward)}, {'optimum' if item.id == 'optimum' else 'myopic'}",
                percent_text(item.soc_min),
                f"{outcome.reward_sum:.1f}",
                f"{printed.fuel_gal:.2f}",
                f"{fuel:.3f}",
                f"{signed(fuel - printed.fuel_gal, 3)}",
                NONE if outcome.efficiency is None else percent_text(outcome.efficiency),
                percent_text(printed.soc_final),
                percent_text(outcome.soc_final),
                f"{signed(100 * (outcome.soc_final - printed.soc_final), 1)} points",
                f"{signed(above, 1)} points",
            )
        )
        if item.id == "optimum" and item.reward == "piecewise":
            ends.append(
                f"SOC_min {percent_text(item.soc_min)}: ends {above:.1f} points above it, "
                f"{fuel:.2f} gal"
            )
    notes = []
    if ends:
        notes.append(
            "Optimum of the shaped reward as printed, " + "; ".join(ends) + ". Where it ends at "
            "SOC_min whatever SOC_min is, an equal final SOC says nothing about planning."
        )
    return Table(
        "optimum",
        "True optimum of each reward",
        "Exact DP on the reward itself, and the policy that is greedy on the next reward alone. "
        "Beside them the paper's row of that kind: DDQN without shaping for the fuel reward, with "
        "shaping for the others.",
        (
            "reward, drive",
            "SOC_min",
            "return",
            "fuel [gal], paper",
            "fuel [gal], here",
            "fuel [gal], difference",
            "efficiency, here",
            "final SOC, paper",
            "final SOC, here",
            "final SOC, difference",
            "final SOC above SOC_min",
        ),
        tuple(rows),
        tuple(notes),
    )


def _ablations(results: StudyResults) -> Table:
    rows = []
    for base_key, changed in ABLATIONS:
        base = _row_of(results, base_key)
        for key in (base_key, *changed):
            row, runs = _row_of(results, key), results.of(key)
            name = row_name(key) if key != base_key else f"**{row_name(key)}**"
            if row is None:
                rows.append((name, percent_text(soc_min_of(key)), *[NOT_RUN] * 7))
                continue
            episodes = episodes_to_convergence(runs)
            change = "row of the paper"
            if key != base_key:
                change = _change(base, row) if base is not None else "base was not run"
            rows.append(
                (
                    name,
                    percent_text(row.soc_min),
                    change,
                    measure_text(measure(runs, lambda o: o.dp_ratio), True, 1.0, 4, ""),
                    measure_text(
                        measure_values([way_to_optimum(results, run) for run in runs]),
                        True, 100.0, 1, " %",
                    ),
                    measure_text(measure(runs, fuel_gal), True, 1.0, 3, ""),
                    measure_text(measure(runs, lambda o: o.efficiency), True, 100.0, 1, " %"),
                    measure_text(measure(runs, lambda o: o.soc_final), True, 100.0, 1, " %"),
                    NONE if episodes is None else episodes.text,
                )
            )  # fmt: skip
    return Table(
        "ablations",
        "Ablations",
        "Each block: a row of the paper (bold), then the same with what stands under `change`.",
        (
            "row",
            "SOC_min",
            "change",
            "dp_ratio",
            "way to the reward's optimum",
            "fuel [gal]",
            "efficiency",
            "final SOC",
            "episodes",
        ),
        tuple(rows),
    )


_SETTINGS = {
    "reward": "reward",
    "mapping": "action mapping",
    "actions": "actions",
    "soc_bins": "SOC bins",
    "interpolate": "interpolation",
    "replay": "seeds in the replay",
    "margin": "margin",
    "target_every": "target every",
    "target_rate": "target rate",
}


def _change(base: Row, row: Row) -> str:
    before, after = asdict(base), asdict(row)
    return (
        "; ".join(
            f"{name}: {_setting(before[field])} to {_setting(after[field])}"
            for field, name in _SETTINGS.items()
            if before[field] != after[field]
        )
        or "none"
    )


def _setting(value: object) -> str:
    if value is None:
        return "continuous"
    if isinstance(value, bool):
        return "on" if value else "off"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _row_of(results: StudyResults, key: str) -> Row | None:
    runs = results.of(key)
    return runs[0].row if runs else None


def _cost(results: StudyResults) -> Table:
    rows = []
    for row in results.rows:
        runs = results.of(row.key)
        seconds = [max(run.seconds, 1e-9) for run in runs]
        rows.append(
            (
                row.label,
                percent_text(row.soc_min),
                str(len(runs)),
                _range([run.episodes for run in runs]),
                _range([run.steps for run in runs]),
                _range([run.updates for run in runs]),
                _rate(runs, seconds, lambda run: run.steps),
                _rate(runs, seconds, lambda run: run.updates),
                f"{np.median(seconds):,.0f}",
                f"{sum(seconds) / 3600:.2f}",
                f"{max(run.peak_rss_bytes for run in runs) / 1e6:,.0f}",
            )
        )
    total_h = sum(run.seconds for run in results.runs) / 3600
    return Table(
        "cost",
        "Cost",
        "Per run, evaluations included; rates and wall time are medians over seeds, memory is the "
        "largest.",
        (
            "row",
            "SOC_min",
            "seeds",
            "episodes",
            "transitions",
            "updates",
            "transitions/s",
            "updates/s",
            "wall per run [s]",
            "wall, all seeds [h]",
            "peak memory [MB]",
        ),
        tuple(rows),
        (f"{len(results.runs)} runs, {total_h:.2f} process hours.",),
    )


def _rate(runs: Sequence[Run], seconds: Sequence[float], count: Callable[[Run], int]) -> str:
    return f"{np.median([count(run) / s for run, s in zip(runs, seconds, strict=True)]):,.0f}"


def _range(values: Sequence[int]) -> str:
    low, high = min(values), max(values)
    return f"{low:,}" if low == high else f"{low:,}-{high:,}"


def _differences(results: StudyResults) -> Table:
    return Table(
        "differences",
        "Differences from the paper",
        "Where the paper is silent or cannot be followed, what was chosen and why.",
        ("subject", "paper", "here", "why"),
        tuple(
            (item["subject"], item["paper"], item["here"], item["why"])
            for item in results.differences
        ),
    )


def claims_table(results: StudyResults) -> Table:
    """Every claim with its verdict."""
    return Table(
        "claims",
        "Claims of the paper",
        "Verdict rules were fixed before the results. A difference needs 5 seeds and a 95 % "
        "interval that excludes equality.",
        ("claim", "where", "tried on", "verdict", "evidence"),
        tuple(
            (item.text, item.where, item.setting, f"**{item.verdict}**", item.evidence)
            for item in claims(results)
        ),
    )


def slips_table() -> Table:
    """The paper's inconsistencies."""
    return Table(
        "slips",
        "Slips of the paper",
        "",
        ("subject", "printed", "what follows", "where"),
        tuple((item.subject, item.printed, item.follows, item.where) for item in slips()),
    )


def _reward_name(reward: str) -> str:
    return REWARD_NAMES.get(reward, reward)
