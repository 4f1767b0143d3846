"""``ems evaluate`` over many runs: one JSON document, one CSV, bad words refused at once."""

import csv
import json

import numpy as np
import pytest

from tractor_ems.cli import main
from tractor_sim.duty_cycle.library import cycle_names


@pytest.fixture
def cycles(tmp_path, monkeypatch):
    """Two short cycles in files."""
    monkeypatch.chdir(tmp_path)
    for name, power_w in (("short", 100e3), ("long", 150e3)):
        rows = "\n".join(f"{k},{power_w}" for k in range(20))
        (tmp_path / f"{name}.csv").write_text(f"time_s,power_demand_w\n{rows}\n")
    return ("--cycle", "short.csv", "--cycle", "long.csv", "--no-dp", "--jobs", "1")


def results(capsys, *argv):
    assert main(["evaluate", *argv, "--json"]) == 0
    return json.loads(capsys.readouterr().out)["results"]


def refusal(capsys, *argv):
    assert main(["evaluate", *argv]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1, captured.err
    return captured.err


def test_policies_by_comma_and_by_repetition_meet_every_cycle(capsys, cycles):
    policies = ("--policy", "conventional,best_point", "--policy", "load_levelling")
    rows = results(capsys, *policies, *cycles)
    assert [(row["cycle"], row["policy"]) for row in rows] == [
        (cycle, policy)
        for cycle in ("short", "long")
        for policy in ("conventional", "best_point", "load_levelling")
    ]
    assert all(row["dp_ratio"] is None and row["dp_note"] == "not asked for" for row in rows)


def test_one_policy_on_one_cycle_is_a_bare_result(capsys, cycles):
    assert main(["evaluate", "--policy", "conventional", *cycles[2:], "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["policy"] == "conventional"


def test_a_csv_holds_what_the_json_holds(capsys, cycles, tmp_path):
    rows = results(capsys, "--policy", "conventional,best_point", *cycles, "--csv", "out/r.csv")
    with (tmp_path / "out" / "r.csv").open(newline="") as file:
        read = list(csv.DictReader(file))
    assert [row["policy"] for row in read] == [row["policy"] for row in rows]
    for text, row in zip(read, rows, strict=True):
        assert text.keys() == row.keys()
        assert float(text["fuel_kg"]) == row["fuel_kg"]
        assert text["fuel_l_per_ha"] == "", "no area is an empty cell"


def test_the_table_names_every_run_and_sums_up_by_policy(capsys, cycles):
    assert main(["evaluate", "--policy", "conventional,best_point", *cycles]) == 0
    shown = capsys.readouterr().out
    for word in ("short", "long", "conventional", "best_point", "per policy", "dp_ratio"):
        assert word in shown


def test_a_set_is_every_cycle_listed_in_it(capsys, monkeypatch):
    from tractor_ems import evaluate_set
    from tractor_ems.evaluate_set import FailedRun

    monkeypatch.setattr(
        evaluate_set,
        "evaluate_all",
        lambda runs, options, **_: [FailedRun(run, "not in this test") for run in runs],
    )
    argv = ["evaluate", "--policy", "conventional", "--set", "validation", "--json"]
    assert main(argv) == 3, "runs that could not be made"
    captured = capsys.readouterr()
    rows = json.loads(captured.out)["results"]
    assert [row["cycle"] for row in rows] == cycle_names("validation")
    assert {row["split"] for row in rows} == {"validation"}
    assert captured.err.count("\n") == 1 and "not driven" in captured.err


def test_a_powertrain_with_changed_settings_stays_one_name(capsys, cycles):
    name = "field:engine.start_fuel_kg=0.06,engine.min_on_s=3"
    rows = results(capsys, "--powertrain", name, "--policy", "conventional,best_point", *cycles)
    assert {row["powertrain"] for row in rows} == {name}
    assert np.all([row["violations"] == 0 for row in rows])


@pytest.mark.parametrize(
    ("argv", "named"),
    [
        (("--set", "test"), "train, validation, held-out"),
        (("--policy", "conventional,ddpn"), "ddpn"),
        (("--policy", "conventional,"), "empty name"),
        (("--policy", "conventional,dp", "--record", "bag"), "--record"),
        (("--policy", "conventional,dp", "--plot", "a.png"), "--plot"),
        (("--policy", "conventional,default", "--powertrain", "wheel_loader"), "none ships"),
        (("--jobs", "0", "--policy", "conventional,dp"), "--jobs"),
    ],
)
def test_bad_words_are_refused_before_anything_is_driven(capsys, argv, named):
    assert named in refusal(capsys, *argv)
