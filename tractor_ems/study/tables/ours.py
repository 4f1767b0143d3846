"""Tables that the paper does not have: baselines beside every learner, the true optimum of each
reward, ablations, cost, differences from the paper, claims and slips."""

from collections.abc import Sequence

from tractor_ems.study.claims import claims
from tractor_ems.study.convergence import MIN_SEEDS
from tractor_ems.study.drive_claims import SOLVED
from tractor_ems.study.findings import soc_min_paragraph
from tractor_ems.study.paper_values import SUMMARY
from tractor_ems.study.results import Outcome, StudyResults
from tractor_ems.study.slips import slips
from tractor_ems.study.tables.ablations import ablations_table
from tractor_ems.study.tables.cost import cost_tables
from tractor_ems.study.tables.measures import (
    BASELINE_NAMES,
    NOT_RUN,
    Measure,
    episodes_to_optimum,
    find_baseline,
    fuel_gal,
    measure_values,
    reward_name,
    soc_min_text,
)
from tractor_ems.study.tables.quantities import NONE, measure_text, percent_text, signed
from tractor_ems.study.tables.reasons import way_to_optimum
from tractor_ems.study.tables.seeds import seeds_table
from tractor_ems.study.tables.table import Table

KINDS = {"silent": "silent", "different": "done otherwise", "slip": "a slip"}
"""Of a difference from the paper."""


def our_tables(results: StudyResults) -> tuple[Table, ...]:
    """All of them, in the order of the report."""
    return (
        *_beside(results),
        _optimum(results),
        ablations_table(results),
        seeds_table(results),
        *cost_tables(results),
        _differences(results),
        claims_table(results),
        slips_table(),
    )


def _beside(results: StudyResults) -> tuple[Table, ...]:
    """Per reward and SOC_min that has a learner: what does not learn, then every learner."""
    settings = dict.fromkeys((row.reward, row.soc_min) for row in results.rows)
    return tuple(_beside_one(results, reward, soc_min) for reward, soc_min in settings)


def _beside_one(results: StudyResults, reward: str, soc_min: float) -> Table:
    rows, notes = [], []
    low = find_baseline(results, "random_feasible", reward, soc_min)
    high = find_baseline(results, "optimum", reward, soc_min)
    for name, shown in BASELINE_NAMES.items():
        found = find_baseline(results, name, reward, soc_min)
        if found is None:
            rows.append((shown, *[NOT_RUN] * 10))
            continue
        way = None
        if low is not None and high is not None:
            span = high.outcome.reward_sum - low.outcome.reward_sum
            if span > 0.0:
                way = (found.outcome.reward_sum - low.outcome.reward_sum) / span
        cells = _drive_cells((found.outcome,), False, measure_values([way]))
        rows.append((shown, *cells, NONE))
        if name == "myopic" and way is not None:
            notes.append(_myopic_note(way, found.outcome))
    for row in results.rows:
        if row.reward == reward and abs(row.soc_min - soc_min) < 1e-9:
            runs = results.of(row.key)
            way_here = measure_values([way_to_optimum(results, run) for run in runs])
            outcomes = tuple(run.outcome for run in runs)
            solved = episodes_to_optimum(results, runs)
            cells = _drive_cells(outcomes, True, way_here)
            rows.append((f"**{row.label}**", *cells, NONE if solved is None else solved.text))
    kind = reward_name(reward)
    return Table(
        f"beside_{reward}_{soc_min:g}",
        f"Reward: {kind}; SOC_min {soc_min_text(soc_min)}",
        "Learners in bold. Return in the learner's units; `way` is 0 at random feasible and 100 % "
        "at the exact optimum of this reward. Fuel compares at equal final SOC only, which "
        "`dp_ratio` does. Returns are undiscounted sums; learners maximise a discounted one, so "
        "that not even a perfect learner need reach 100 %.",
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
            "episodes to 95 % of the optimum",
        ),
        tuple(rows),
        tuple(notes),
    )


def _myopic_note(way: float, outcome: Outcome) -> str:
    ratio = "no dp_ratio" if outcome.dp_ratio is None else f"dp_ratio {outcome.dp_ratio:.4f}"
    text = f"Myopic greedy, which learns nothing, is {percent_text(way)} of the way ({ratio})"
    if way >= SOLVED:
        return text + ": on this reward a `way` near 100 % shows no foresight."
    return text + "."


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
    rows = []
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
                f"{reward_name(item.reward)}, {'optimum' if item.id == 'optimum' else 'myopic'}",
                soc_min_text(item.soc_min),
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
    notes = [
        "Why these differ from the paper's rows: they are the optimum and the greed of a reward "
        "at one SOC_min, the paper's are agents that it does not compare with either."
    ]
    paragraph = soc_min_paragraph(results)
    notes += [paragraph] if paragraph else []
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


def _differences(results: StudyResults) -> Table:
    return Table(
        "differences",
        "Differences from the paper",
        "Where the paper is silent or cannot be followed, what was chosen and why.",
        ("subject", "the paper is", "paper", "here", "why"),
        tuple(
            (
                item["subject"],
                KINDS[item["kind"]],
                item["paper"],
                item["here"],
                item["why"],
            )
            for item in results.differences
        ),
    )


def claims_table(results: StudyResults) -> Table:
    """Every claim with its verdict."""
    return Table(
        "claims",
        "Claims of the paper",
        "Verdict rules and thresholds were fixed before the results. A difference needs "
        f"{MIN_SEEDS} seeds and a 95 % interval that excludes equality. The claim on tables was "
        "split in two, by agent, after the first runs had been seen, with the same thresholds: "
        "the two agents differ, and one verdict for both hid it.",
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
