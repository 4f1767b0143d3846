"""The paper's tables again: paper / here / difference, every shaped row at both SOC_min, and a
reason wherever the difference exceeds 2 %."""

from collections.abc import Sequence

from tractor_ems.study.findings import episodes_caveat
from tractor_ems.study.paper_values import (
    DQN_DDQN_FUEL_GAL,
    PEARSON,
    SEEDING,
    SETTINGS,
    SUMMARY,
    TABLE_2,
    UNSHAPED_EFFICIENCY,
    MethodValue,
    episodes_of,
    episodes_text,
)
from tractor_ems.study.results import StudyResults
from tractor_ems.study.statistics import strength_of
from tractor_ems.study.tables.measures import (
    NOT_RUN,
    REWARD_NAMES,
    SOC_MINS,
    find_baseline,
    measure_values,
    row_name,
    soc_min_text,
)
from tractor_ems.study.tables.quantities import (
    DP_RATIO,
    EFFICIENCY,
    EFFICIENCY_OF_DP,
    EPISODES,
    FUEL,
    FUEL_KG,
    FUEL_OF_DP,
    LARGE,
    NONE,
    REDUCTION,
    SOC_FINAL,
    Entry,
    Printed,
    Quantity,
    measure_text,
    percent_text,
    signed,
)
from tractor_ems.study.tables.reasons import reason
from tractor_ems.study.tables.table import Table
from tractor_ems.study.tables.table_1 import table_1

_BASELINES = ("conventional", "dp")
_MEASURED_ONLY = (FUEL_KG, DP_RATIO)
_REASON = f"reason, above {percent_text(LARGE, 0)}"
_INTERVAL = "Here: interquartile mean over seeds [95 % bootstrap interval]."
_HERE = f"{_INTERVAL} Conventional and DP are calibrated, not reproduced."
_DP_RATIO = (
    "`dp_ratio` is fuel of the optimum that ends at the row's own final SOC over the row's fuel."
)
_EPISODES = "`> N`: censored by the budget. Not comparable one to one with the paper, see below."


def paper_tables(results: StudyResults) -> tuple[Table, ...]:
    """Table 1, Table 2, the summary table in four parts, the seeding table in two, the tabular
    agents. A reason has one mark in all of them."""
    four = [*_entries(results, TABLE_2), *_myopic(results, "fuel", "piecewise")]
    all_rows, seeding = _summary_entries(results), _seeding_entries(results)
    marks: dict[str, str] = {}
    return (
        table_1(results),
        _compare(
            results,
            "table_2",
            "Table 2: four methods",
            f"{_HERE} {_DP_RATIO}",
            four,
            (FUEL, FUEL_KG, EFFICIENCY, SOC_FINAL, DP_RATIO),
            marks,
        ),
        _compare(
            results,
            "summary_fuel",
            "Summary table: fuel",
            f"{_HERE} {_DP_RATIO}",
            all_rows,
            (FUEL, FUEL_KG, DP_RATIO),
            marks,
        ),
        _compare(
            results,
            "summary_efficiency",
            "Summary table: efficiency and final SOC",
            f"{_HERE} The difference from a printed range is counted from its nearer end.",
            all_rows,
            (EFFICIENCY, SOC_FINAL),
            marks,
        ),
        _compare(
            results,
            "summary_episodes",
            "Summary table: episodes until convergence",
            f"{_INTERVAL} {_EPISODES}",
            [entry for entry in all_rows if entry.learner],
            (EPISODES,),
            marks,
            (episodes_caveat(results),),
        ),
        _compare(
            results,
            "summary_relative",
            "Summary table: against conventional and DP",
            "Counted as the paper does, at whatever SOC a drive ends; `dp_ratio` beside it at "
            "equal final SOC.",
            all_rows,
            (REDUCTION, FUEL_OF_DP, EFFICIENCY_OF_DP, DP_RATIO),
            marks,
        ),
        _compare(
            results,
            "seeding",
            "Seeding table: the drives",
            f"{_INTERVAL} {_DP_RATIO} Rule-based seeding stands in the paper's text only.",
            [*seeding, *_myopic(results, "piecewise")],
            (FUEL, FUEL_KG, EFFICIENCY, SOC_FINAL, DP_RATIO),
            marks,
        ),
        _compare(
            results,
            "seeding_episodes",
            "Seeding table: episodes until convergence",
            f"{_INTERVAL} {_EPISODES}",
            seeding,
            (EPISODES,),
            marks,
            (episodes_caveat(results),),
        ),
        _tabular(results),
    )


def _compare(
    results: StudyResults,
    name: str,
    title: str,
    caption: str,
    entries: Sequence[Entry],
    quantities: Sequence[Quantity],
    marks: dict[str, str],
    notes: Sequence[str] = (),
) -> Table:
    columns = ["method", "SOC_min"]
    for quantity in quantities:
        if quantity in _MEASURED_ONLY:
            columns.append(f"{quantity.name}, here")
        else:
            columns += [f"{quantity.name}, {part}" for part in ("paper", "here", "difference")]
    columns.append(_REASON)
    used: dict[str, str] = {}
    rows = []
    for entry in entries:
        cells = [entry.label, soc_min_text(entry.soc_min)]
        large = set()
        for quantity in quantities:
            compared = quantity.compare(results, entry)
            if compared.large:
                large.add(quantity)
            if quantity in _MEASURED_ONLY:
                cells.append(compared.here)
            else:
                cells += [compared.paper, compared.here, compared.difference]
        why = ""
        if large or not entry.outcomes:
            why = reason(
                results, entry, drive=bool(large - {EPISODES}), episodes=EPISODES in large
            )
        if why:
            used[why] = marks.setdefault(why, f"({len(marks) + 1})")
        cells.append(used.get(why, NONE))
        rows.append(tuple(cells))
    below = [*(f"{mark} {why}." for why, mark in used.items()), *notes]
    if DP_RATIO in quantities:
        below += _dp_notes(entries)
    return Table(name, title, caption, tuple(columns), tuple(rows), tuple(below))


def _dp_notes(entries: Sequence[Entry]) -> tuple[str, ...]:
    """Why a drive has no dp_ratio."""
    found = {
        f"{entry.label}, SOC_min {soc_min_text(entry.soc_min)}: no dp_ratio, {outcome.dp_note}"
        for entry in entries
        for outcome in entry.outcomes
        if outcome.dp_ratio is None and outcome.dp_note
    }
    return tuple(sorted(found))


def _entries(results: StudyResults, printed: Sequence[MethodValue]) -> list[Entry]:
    return [
        entry
        for value in printed
        for entry in _of(results, value.id, value.label, Printed.of(value))
    ]


def _of(results: StudyResults, row_id: str, label: str, printed: Printed) -> list[Entry]:
    """One entry, or one per SOC_min for shaped rows."""
    if row_id in _BASELINES:
        baseline = find_baseline(results, row_id)
        return [Entry(f"{label} (calibrated)", SOC_MINS[0], (), baseline, False, printed)]
    limits = SOC_MINS if row_id.startswith("ddqn_shaped") else SOC_MINS[:1]
    return [
        Entry(label, soc_min, results.of(f"{row_id}@{soc_min:g}"), None, True, printed)
        for soc_min in limits
    ]


def _myopic(results: StudyResults, *rewards: str) -> list[Entry]:
    """What looking at the next reward alone does, at every SOC_min that learners have."""
    return [
        Entry(
            f"Myopic greedy, no learning, reward: {REWARD_NAMES[reward]}",
            soc_min,
            (),
            found,
            False,
            Printed(),
        )
        for reward in rewards
        for soc_min in (SOC_MINS if reward == "piecewise" else SOC_MINS[:1])
        if (found := find_baseline(results, "myopic", reward, soc_min)) is not None
    ]


def _summary_entries(results: StudyResults) -> list[Entry]:
    """The paper's six rows; the tabular agents, DQN and myopic greedy, which it has no row for."""
    dqn = Printed(DQN_DDQN_FUEL_GAL, UNSHAPED_EFFICIENCY, None, episodes_of("dqn"))
    entries = _entries(results, SUMMARY)
    return [
        *entries[:2],
        *_of(results, "q", "Q-learning (no row in the paper)", Printed()),
        *_of(results, "double_q", "Double Q-learning (no row in the paper)", Printed()),
        *_of(results, "dqn", "DQN (text of the paper)", dqn),
        *entries[2:],
        *_myopic(results, "fuel", "piecewise"),
    ]


def _seeding_entries(results: StudyResults) -> list[Entry]:
    rule = Printed(episodes=episodes_of("ddqn_shaped_rule"))
    return [
        *_entries(results, SEEDING),
        *_of(results, "ddqn_shaped_rule", "DDQN (RB data, text of the paper)", rule),
    ]


def _tabular(results: StudyResults) -> Table:
    rows = []
    for row_id in ("q", "double_q", "double_q_interpolated"):
        tables = [run.table for run in results.of(f"{row_id}@0.7") if run.table is not None]
        if not tables:
            rows.append((row_name(row_id), *[NOT_RUN] * 8))
            continue
        r = measure_values([table.pearson for table in tables])
        printed = row_id == "double_q"
        never = measure_values([1.0 - table.pairs_visited / table.pairs for table in tables])
        feasible = measure_values(
            [
                1.0 - min(table.pairs_visited / max(table.pairs_feasible, 1), 1.0)
                for table in tables
            ]
        )
        states = measure_values([float((table.state_visits == 0).mean()) for table in tables])
        value = None if r is None else r.interval.value
        rows.append(
            (
                row_name(row_id),
                measure_text(states, True, 100.0, 1, " %"),
                measure_text(never, True, 100.0, 2, " %"),
                measure_text(feasible, True, 100.0, 2, " %"),
                f"{PEARSON:.3f}" if printed else NONE,
                measure_text(r, True, 1.0, 3, "") if r is not None else "undefined",
                f"{signed(value - PEARSON, 3)}" if printed and value is not None else NONE,
                strength_of(value),
                f"{max(table.bytes for table in tables) / 1e6:.0f}",
            )
        )
    done = max((run.episodes for run in results.runs if run.table is not None), default=0)
    notes = []
    if done < SETTINGS.tabular_episodes:
        notes.append(
            f"Budget: {episodes_text(done)} of the paper's "
            f"{episodes_text(SETTINGS.tabular_episodes)} episodes."
        )
    notes.append(
        "Why r differs from the paper's: the pairs, the table (of two in double Q) and the "
        "reward that it was taken over are not printed, nor is the schedule that decides which "
        f"pairs are visited; {percent_text(LARGE, 0)} of it are {abs(LARGE * PEARSON):.3f}."
    )
    notes.append(
        "The paper does not state over which pairs it correlates; here over pairs updated at "
        "least once, Q against the pair's reward."
    )
    return Table(
        "tabular",
        "Tabular agents: coverage and correlation",
        "Interquartile mean over seeds [95 % interval]. The paper: most pairs rarely or never "
        "encountered; r for double Q-learning.",
        (
            "agent",
            "states never visited",
            "pairs never visited",
            "feasible pairs never visited",
            "Pearson r, paper",
            "Pearson r, here",
            "Pearson r, difference",
            "on the paper's scale",
            "tables [MB]",
        ),
        tuple(rows),
        tuple(notes),
    )
