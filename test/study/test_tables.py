"""Tables are functions of the results: every number is computed, every large difference has a
reason, and what was not run is said."""

import csv
import io
from dataclasses import replace
from functools import lru_cache

import pytest
from study.synthetic import DEFAULT_PLANS, Plan, build_results

from tractor_ems.study.results import Outcome, Run, StudyResults
from tractor_ems.study.tables import Table, build_tables, to_csv, to_json, to_markdown
from tractor_ems.study.tables.quantities import signed
from tractor_msgs_py.errors import ConfigError

PAPER_TABLES = {
    "table_1", "table_2", "summary_fuel", "summary_efficiency", "summary_episodes",
    "summary_relative", "seeding", "tabular",
}  # fmt: skip
OUR_TABLES = {"optimum", "ablations", "cost", "differences", "claims", "slips"}


@lru_cache(maxsize=1)
def full() -> StudyResults:
    return build_results()


@lru_cache(maxsize=4)
def tables_of_full() -> dict[str, Table]:
    return tables(full())


def tables(results: StudyResults) -> dict[str, Table]:
    return {table.name: table for table in build_tables(results)}


def without(results: StudyResults, *keys: str) -> StudyResults:
    return replace(results, runs=tuple(run for run in results.runs if run.row.key not in keys))


def with_outcome(results: StudyResults, key: str, **changes: object) -> StudyResults:
    """The same study, other final drives of one row."""

    def changed(run: Run) -> Run:
        outcome: Outcome = replace(run.outcome, **changes)  # type: ignore[arg-type]
        return replace(run, outcome=outcome) if run.row.key == key else run

    return replace(results, runs=tuple(changed(run) for run in results.runs))


def rows_as_dicts(table: Table) -> list[dict[str, str]]:
    return list(to_json(table)["rows"])


def test_every_table_of_the_paper_and_of_ours_is_built():
    names = set(tables_of_full())
    assert names >= PAPER_TABLES | OUR_TABLES
    # Baselines stand beside the learners of every reward and SOC_min.
    settings = {(row.reward, row.soc_min) for row in full().rows}
    assert {f"beside_{reward}_{soc_min:g}" for reward, soc_min in settings} <= names


def test_comparisons_have_paper_here_and_difference():
    for name in PAPER_TABLES - {"tabular"}:
        columns = tables_of_full()[name].columns
        assert [c for c in columns if c.endswith(", paper")], name
        for column in columns:
            if column.endswith(", paper"):
                quantity = column.removesuffix(", paper")
                assert {f"{quantity}, here", f"{quantity}, difference"} <= set(columns)


def test_every_shaped_row_stands_at_both_soc_min():
    for name in ("table_2", "summary_fuel", "summary_episodes", "seeding"):
        found = {(row["method"], row["SOC_min"]) for row in rows_as_dicts(tables_of_full()[name])}
        shaped = {method for method, _ in found if "Shaping)" in method or "Data)" in method}
        shaped -= {"Baseline DDQN (No Reward Shaping)"}
        assert shaped
        for method in shaped:
            assert {(method, "70.0 %"), (method, "83.6 %")} <= found


def test_numbers_of_the_paper_are_written_as_printed():
    text = to_markdown(tables_of_full()["summary_episodes"])
    for printed in ("40,000", "9,000", "37,000", "25,000", "32,000"):
        assert f"| {printed} |" in text
    fuel = [row["fuel [gal], paper"] for row in rows_as_dicts(tables_of_full()["summary_fuel"])]
    assert fuel == ["1.95", "1.70", "-", "0.34", "0.30", *["1.75"] * 4, *["1.76"] * 2]


def test_a_changed_result_changes_the_table():
    """No result is written into the code: doubling a row's fuel moves its cells and no other's."""
    before = rows_as_dicts(tables_of_full()["summary_fuel"])
    key = "ddqn_shaped_dp@0.836"
    fuel_kg = 2.0 * full().of(key)[0].outcome.fuel_kg
    after = rows_as_dicts(tables(with_outcome(full(), key, fuel_kg=fuel_kg))["summary_fuel"])
    changed = [
        (old["method"], old["SOC_min"])
        for old, new in zip(before, after, strict=True)
        if old["fuel [gal], here"] != new["fuel [gal], here"]
    ]
    assert changed == [("DDQN (Reward Shaping + DP Seeding)", "83.6 %")]
    row = next(row for row in after if (row["method"], row["SOC_min"]) == changed[0])
    assert row["fuel [kg], here"].startswith(f"{fuel_kg:.3f}")


def test_differences_above_two_percent_have_a_reason_and_small_ones_none():
    for name in ("table_2", "summary_fuel", "summary_efficiency", "summary_episodes", "seeding"):
        table = tables_of_full()[name]
        for row in rows_as_dicts(table):
            gaps = [
                abs(float(cell.rsplit("(", 1)[1].rstrip(" %)")))
                for column, cell in row.items()
                if column.endswith("difference") and cell.endswith("%)")
            ]
            reason = row["reason, above 2 %"]
            if gaps and max(gaps) > 2.05:
                assert any(note.startswith(reason) for note in table.notes), row
            if not gaps or max(gaps) < 1.95:
                assert reason == "-"


def test_a_reason_names_budget_the_rewards_optimum_and_soc_min():
    table = tables(
        build_results(plans={**DEFAULT_PLANS, "ddqn_shaped@0.7": Plan(drive="low_power")})
    )
    notes = [note for note in table["summary_fuel"].notes if "37,000" in note]
    assert notes
    for part in ("budget 60 of the paper's 37,000 episodes", "one update per 4 steps",
                 "exact optimum of its reward", "with SOC_min 70.0 % it ends at"):  # fmt: skip
        assert part in notes[0]


def test_calibration_is_named_and_a_miss_is_admitted():
    first = rows_as_dicts(tables_of_full()["table_2"])[0]
    assert "calibrated" in first["method"] and first["reason, above 2 %"] == "-"
    results = full()
    baselines = tuple(
        replace(item, outcome=replace(item.outcome, fuel_kg=1.1 * item.outcome.fuel_kg))
        if item.id == "conventional"
        else item
        for item in results.baselines
    )
    missed = tables(replace(results, baselines=baselines))["table_2"]
    assert missed.rows[0][-1] == "(1)" and "calibration is off" in missed.notes[0]


def test_a_censored_row_says_more_than_and_claims_no_difference():
    results = build_results(plans={**DEFAULT_PLANS, "dqn": Plan(None, "low_power")})
    table = tables(results)["summary_episodes"]
    row = next(row for row in rows_as_dicts(table) if row["method"].startswith("DQN"))
    assert row["episodes, here"].startswith("> 60")
    assert row["episodes, difference"] == "not known (censored)"
    assert any("5 of 5 seeds not converged" in note for note in table.notes)


def test_rows_that_were_not_run_are_said_and_nothing_breaks():
    gone = ("ddqn_shaped_dp@0.7", "dqn@0.7", "double_q@0.7", "ddqn_shaped@0.836")
    found = tables(without(full(), *gone))
    assert set(found) >= PAPER_TABLES | OUR_TABLES
    rows = rows_as_dicts(found["summary_fuel"])
    dqn = next(row for row in rows if row["method"].startswith("DQN"))
    assert dqn["fuel [gal], here"] == "not run" and dqn["fuel [gal], difference"] == "-"
    assert any(note.endswith("not run.") for note in found["summary_fuel"].notes)
    assert any(row["agent"] == "double Q-learning" and row["pairs never visited"] == "not run"
               for row in rows_as_dicts(found["tabular"]))  # fmt: skip


def test_an_empty_study_still_gives_every_table():
    empty = replace(full(), runs=(), baselines=(), table1=(), differences=())
    found = tables(empty)
    assert set(found) >= PAPER_TABLES | OUR_TABLES
    assert "not run" in to_markdown(found["table_1"])


def test_one_seed_has_no_interval():
    results = build_results(seeds=1)
    rows = rows_as_dicts(tables(results)["summary_fuel"])
    shaped = next(row for row in rows if row["method"] == "DDQN (Reward Shaping)")
    assert shaped["fuel [gal], here"].endswith("(1 run)") and "[" not in shaped["fuel [gal], here"]


def test_a_drive_without_dp_ratio_says_why():
    results = with_outcome(full(), "ddqn@0.7", dp_ratio=None, dp_note="12 J of demand unmet")
    table = tables(results)["summary_fuel"]
    assert any("no dp_ratio, 12 J of demand unmet" in note for note in table.notes)


def test_a_drive_that_burnt_nothing_has_no_efficiency():
    results = with_outcome(
        full(), "ddqn@0.7", fuel_kg=0.0, efficiency=None, below_60kw_share=None, dp_ratio=1.0
    )
    rows = rows_as_dicts(tables(results)["summary_relative"])
    row = next(row for row in rows if row["method"].startswith("Baseline"))
    assert row["efficiency, % of DP achieved, here"] == "-"
    assert row["less fuel than conventional, here"].startswith("100.0 %")


@pytest.mark.parametrize("seeds", [1, 5])
def test_nothing_that_is_not_a_number_is_shown(seeds):
    for table in build_tables(build_results(seeds=seeds)):
        words = to_markdown(table).lower().replace("|", " ").split()
        assert not {"nan", "inf", "-inf", "none"} & set(words), table.name


def test_ablations_name_what_changed():
    rows = {row["row"]: row["change"] for row in rows_as_dicts(tables_of_full()["ablations"])}
    assert rows["DDQN, shaped, engine knots"] == (
        "action mapping: p_batt_grid to p_eng_knots; actions: 1600 to 65"
    )
    assert rows["DDQN, shaped, continuous SOC"] == "SOC bins: 200 to continuous"
    assert rows["double Q, interpolated"] == "interpolation: off to on"
    assert rows["DDQN, shaped, DP kept"] == "seeds in the replay: fifo to kept"


def test_the_optimum_of_the_printed_reward_is_told_from_the_papers_row():
    table = tables_of_full()["optimum"]
    row = next(
        row for row in rows_as_dicts(table)
        if row["reward, drive"] == "shaped, as printed, optimum" and row["SOC_min"] == "70.0 %"
    )  # fmt: skip
    assert row["final SOC, here"] == "70.0 %" and row["final SOC, paper"] == "83.6 %"
    assert row["final SOC above SOC_min"] == "+0.0 points"


def test_cost_counts_transitions_and_updates_per_second():
    row = rows_as_dicts(tables_of_full()["cost"])[0]
    assert row["transitions/s"] == f"{766 * 60:,}" and row["updates/s"] == f"{766 * 60 // 4:,}"


def test_csv_and_json_hold_the_same_cells():
    table = tables_of_full()["summary_fuel"]
    lines = list(csv.reader(io.StringIO(to_csv(table))))
    assert tuple(lines[0]) == table.columns and tuple(map(tuple, lines[1:])) == table.rows
    assert [tuple(row.values()) for row in rows_as_dicts(table)] == list(table.rows)


def test_markdown_keeps_a_cell_in_its_cell():
    table = Table("t", "", "", ("a", "b"), (("x | y\nz", ""),))
    assert to_markdown(table).splitlines()[-1] == "| x \\| y z | - |"


def test_a_ragged_table_is_refused():
    with pytest.raises(ConfigError, match="a row of 1 cells, allowed 2"):
        Table("t", "", "", ("a", "b"), (("x",),))


def test_what_rounds_to_nothing_has_no_minus():
    assert signed(-0.0004, 3) == "+0.000" and signed(-39603.2, 0) == "-39,603"
