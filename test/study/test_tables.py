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
from tractor_ems.study.tables.ablations import aliasing_or_size, changes
from tractor_ems.study.tables.quantities import signed
from tractor_msgs_py.errors import ConfigError

PAPER_TABLES = {
    "table_1", "table_2", "summary_fuel", "summary_efficiency", "summary_episodes",
    "summary_relative", "seeding", "seeding_episodes", "tabular",
}  # fmt: skip
OUR_TABLES = {"optimum", "ablations", "seeds", "cost", "differences", "claims", "slips"}


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


@pytest.mark.slow
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
            assert {(method, "70 %"), (method, "83.6 %")} <= found


def test_numbers_of_the_paper_are_written_as_printed():
    text = to_markdown(tables_of_full()["summary_episodes"])
    for printed in ("40,000", "9,000", "37,000", "25,000", "32,000"):
        assert f"| {printed} |" in text
    fuel = [row["fuel [gal], paper"] for row in rows_as_dicts(tables_of_full()["summary_fuel"])]
    assert fuel == ["1.95", "1.70", "-", "-", "0.34", "0.30", *["1.75"] * 4, *["1.76"] * 2, *"---"]


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
                 "exact optimum of its reward", "with SOC_min 70 % it ends at"):  # fmt: skip
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


def test_ablations_name_every_setting_that_differs_and_from_which_row():
    rows = {row["row"]: row["against, and what differs"]
            for row in rows_as_dicts(tables_of_full()["ablations"])}  # fmt: skip
    knots = "action mapping: p_batt_grid to p_eng_knots; actions: 1600 to 65"
    assert rows["DDQN, shaped, engine knots"] == f"against DDQN, shaped: {knots}"
    assert rows["DDQN, shaped, continuous SOC"] == (
        "against DDQN, shaped: SOC bins: 200 to continuous"
    )
    assert rows["double Q, interpolated"] == "against double Q-learning: interpolation: off to on"
    kept = "seeds in the replay: fifo to kept"
    assert rows["DDQN, shaped, DP kept"] == f"against DDQN, shaped, DP seeds: {kept}"
    # The margin needs kept seeds: alone it is a change of the row that keeps them.
    assert rows["DDQN, shaped, DP kept, margin"] == (
        f"against DDQN, shaped, DP seeds: {kept}; margin: 0 to 0.8; "
        "against DDQN, shaped, DP kept: margin: 0 to 0.8"
    )


def test_a_difference_that_no_table_names_is_still_shown():
    base = full().of("ddqn@0.7")[0].row
    other = replace(base, label="x", soc_min=0.836, epsilon_start=0.5, algorithm="dqn")
    assert changes(base, other) == (
        "algorithm: ddqn to dqn; SOC_min: 70 % to 83.6 %; epsilon at the start: 1 to 0.5"
    )


def test_aliasing_is_told_from_table_size_by_the_interpolated_table():
    def answer(before: str, after: str, seeds: int = 5) -> str:
        plans = {"double_q": Plan(0.5, before), "double_q_interpolated": Plan(0.5, after)}
        return aliasing_or_size(build_results(plans={**DEFAULT_PLANS, **plans}, seeds=seeds))

    assert "Aliasing between SOC bins is part of it; the rest" in answer("poor", "low_power")
    assert "enough to explain it" in answer("poor", "myopic")
    assert "Aliasing is not what holds the table back" in answer("low_power", "poor")
    assert "the interval of the difference includes 0" in answer("poor", "poor")
    assert "2 seeds, 5 are needed" in answer("poor", "myopic", 2)
    assert "not run" in aliasing_or_size(without(full(), "double_q_interpolated@0.7"))


def test_seeds_are_reported_with_the_episode_in_which_they_are_gone():
    rows = rows_as_dicts(tables_of_full()["seeds"])
    dp = next(r for r in rows if r["row"] == "DDQN, shaped, DP seeds")
    mixed = [r for r in rows if r["row"] == "DDQN, shaped, DP + rule seeds"]
    # 200,000 less 50,000 seeds is 196.1 episodes of 765 transitions, 200,000 is 261.4.
    assert (dp["overwritten from episode"], dp["gone in episode"]) == ("197", "262")
    assert {r["overwritten from episode"] for r in mixed} == {"131"}
    assert [r["expert"] for r in mixed[:2]] == ["DP", "rule base"]
    assert (dp["bags"], dp["seeded"], dp["share of the replay"]) == ("66", "50,000", "25.0 %")
    kept = next(r for r in rows if r["row"] == "DDQN, shaped, DP kept")
    assert kept["gone in episode"] == "never"
    notes = " ".join(tables_of_full()["seeds"].notes)
    assert "MCAP" in notes and "of the paper's 25,000 episodes" in notes and "1.0 %" in notes


def test_table_1_is_calibrated_throughout_and_says_to_what():
    table = tables_of_full()["table_1"]
    assert all(row[0].endswith("(calibrated)") for row in table.rows)
    text = " ".join(table.notes)
    for part in ("118 kW", "115 kW", "60 kW", "without a guard", "72.3 %", "780 s", "216 kW",
                 "87 kWh", "seed 6"):  # fmt: skip
        assert part in text, part


def test_myopic_greed_stands_beside_the_learners_in_the_papers_tables():
    for name in ("table_2", "summary_fuel", "seeding"):
        rows = [r for r in rows_as_dicts(tables_of_full()[name]) if "Myopic" in r["method"]]
        assert {r["SOC_min"] for r in rows} == {"70 %", "83.6 %"}, name
        assert all(r["dp_ratio, matched SOC, here"][:2] == "0." for r in rows)
        assert all(r["fuel [kg], here"] != "-" for r in rows)


def test_a_reason_has_the_same_mark_in_every_table():
    text_of: dict[str, str] = {}
    for name in sorted(PAPER_TABLES):
        for note in tables_of_full()[name].notes:
            if note.startswith("("):
                mark, text = note.split(" ", 1)
                assert text_of.setdefault(mark, text) == text
    assert len(set(text_of.values())) == len(text_of) > 3


def test_learners_have_episodes_to_the_optimum_beside_episodes_to_convergence():
    rows = {r["row"]: r for r in rows_as_dicts(tables_of_full()["ablations"])}
    settled, solved = "episodes", "episodes to 95 % of the optimum"
    ddqn = rows["**DDQN**"]
    assert ddqn[settled].startswith("12") and ddqn[solved].startswith("> 60")
    beside = rows_as_dicts(tables_of_full()["beside_fuel_0.7"])
    assert next(r for r in beside if r["drive"] == "**DDQN**")[solved] == ddqn[solved]


def test_only_settings_with_a_learner_have_a_table_of_learners():
    assert "beside_fuel_0.836" not in tables_of_full()


def test_speeds_are_shown_where_they_were_measured():
    speed = [{"what": "tabular Q", "per_s": 312_345.6, "unit": "transitions"}]
    results = replace(full(), provenance={**full().provenance, "speed": speed})
    assert "speed" not in tables_of_full()
    assert tables(results)["speed"].rows == (("tabular Q", "312,346", "transitions"),)


def test_the_optimum_of_the_printed_reward_is_told_from_the_papers_row():
    table = tables_of_full()["optimum"]
    row = next(
        row for row in rows_as_dicts(table)
        if row["reward, drive"] == "shaped, as printed, optimum" and row["SOC_min"] == "70 %"
    )  # fmt: skip
    assert row["final SOC, here"] == "70.0 %" and row["final SOC, paper"] == "83.6 %"
    assert row["final SOC above SOC_min"] == "+0.0 points"


def test_cost_counts_transitions_and_updates_per_second():
    row = rows_as_dicts(tables_of_full()["cost"])[0]
    assert row["transitions per wall second"] == f"{766 * 60:,}"
    assert row["updates per wall second"] == f"{766 * 60 // 4:,}"


def test_csv_and_json_hold_the_same_cells():
    table = tables_of_full()["summary_fuel"]
    lines = list(csv.reader(io.StringIO(to_csv(table))))
    assert tuple(lines[0]) == table.columns and tuple(map(tuple, lines[1:])) == table.rows
    assert [tuple(row.values()) for row in rows_as_dicts(table)] == list(table.rows)


def test_markdown_keeps_a_cell_in_its_cell():
    table = Table("t", "", "", ("a", "b"), (("x | y\nz", ""),))
    assert to_markdown(table).splitlines()[-1] == "| x \\| y z | - |"


def test_numbers_are_aligned_to_the_right_and_marks_hashes_and_lists_are_not():
    columns = ("n", "mark", "hash", "seeds")
    rows = (("1,234 [1, 2]", "(1)", "81daee6a", "0, 1, 2"), ("> 300", "-", "11cb", "0, 1"))
    lines = to_markdown(Table("t", "", "", columns, rows)).splitlines()
    assert lines[1] == "| --: | :-- | :-- | :-- |"


def test_a_ragged_table_is_refused():
    with pytest.raises(ConfigError, match="a row of 1 cells, allowed 2"):
        Table("t", "", "", ("a", "b"), (("x",),))


def test_what_rounds_to_nothing_has_no_minus():
    assert signed(-0.0004, 3) == "+0.000" and signed(-39603.2, 0) == "-39,603"
