"""``ems dp`` on plants with engine state: one cycle with its trace, and sets of cycles."""

import csv
import dataclasses
import json

import numpy as np
import pytest

from tractor_ems.cli import main
from tractor_ems.optimal import optimum_set
from tractor_ems.optimal.optimum import TRACE_COLUMNS, find_optimum, write_trace
from tractor_ems.optimal.optimum_set import find_optima
from tractor_ems.policies.dp import solve_policy
from tractor_ems.policies.planned import PlannedPolicy
from tractor_ems.scenario import make_scenario
from tractor_msgs_py.errors import ConfigError
from tractor_sim.config import load_powertrain
from tractor_sim.duty_cycle import library
from tractor_sim.duty_cycle.cycle_csv import write_cycle_csv
from tractor_sim.duty_cycle.generate import generate
from tractor_sim.duty_cycle.library import cycle_names

FIELD = load_powertrain("field")
LOADER = generate("loader", 5, duration_s=600)
DEMAND_W = LOADER.power_demand_w[:240] + FIELD.p_aux_w


@pytest.fixture(scope="module")
def cycle_files(tmp_path_factory):
    """160 and 10 steps of loader work."""
    folder = tmp_path_factory.mktemp("cycle")
    paths = []
    for steps in (160, 10):
        paths.append(folder / f"loader_{steps}_steps.csv")
        demand_w = LOADER.power_demand_w[:steps]
        write_cycle_csv(paths[-1], dataclasses.replace(LOADER, power_demand_w=demand_w))
    return [str(path) for path in paths]


@pytest.fixture(scope="module")
def cycle_file(cycle_files):
    return cycle_files[0]


def test_the_trace_is_the_driven_run_with_its_co_state(tmp_path):
    found = find_optimum(FIELD, DEMAND_W, 0.55, 0.551)
    path = tmp_path / "new" / "trace.csv"
    write_trace(path, found, FIELD.dt_s)
    rows = list(csv.DictReader(path.open()))
    assert tuple(rows[0]) == TRACE_COLUMNS
    column = {name: np.array([float(row[name]) for row in rows]) for name in TRACE_COLUMNS}
    np.testing.assert_array_equal(column["time_s"], np.arange(240.0))
    np.testing.assert_array_equal(column["power_demand_w"], DEMAND_W)
    balance_w = column["battery_power_w"] + column["engine_power_w"] - DEMAND_W
    assert np.abs(balance_w).max() < 1e-3
    assert column["fuel_kg"].sum() == pytest.approx(found.trajectory.fuel_kg.sum(), rel=1e-12)
    np.testing.assert_array_equal(column["co_state_kg_per_j"], found.co_state_kg_per_j)


def test_the_policy_that_is_evaluated_drives_the_optimum_that_is_reported():
    policy = solve_policy(FIELD, DEMAND_W, 0.55, 0.551)
    found = find_optimum(FIELD, DEMAND_W, 0.55, 0.551)
    assert isinstance(policy, PlannedPolicy)
    np.testing.assert_array_equal(policy.engine_power_w, found.policy.engine_power_w)
    assert found.trajectory.soc_final == pytest.approx(0.551, abs=1e-6)


def test_dp_prints_certificate_and_co_state(capsys, tmp_path, cycle_file):
    trace = tmp_path / "trace.csv"
    command = ["dp", "--powertrain", "field", "--cycle", cycle_file, "--certify", "--json"]
    assert main([*command, "--trace", str(trace)]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["certificate"]["ok"]
    assert document["certificate"]["bracket_width"] <= 0.005
    assert 0.995 <= document["dp_ratio"] <= 1.0005
    assert len(document["co_state_kg_per_j"]) == 160
    assert len(trace.read_text().splitlines()) == 161


def test_a_free_end_with_a_price_is_solved(capsys, cycle_file):
    command = ["dp", "--powertrain", "field", "--cycle", cycle_file, "--json", "--free-end"]
    assert main(command) == 0
    free = json.loads(capsys.readouterr().out)
    assert main([*command, "--end-price", "70"]) == 0
    priced = json.loads(capsys.readouterr().out)
    assert priced["soc_final"] > free["soc_final"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--free-end"], "powertrain paper"),
        (["--powertrain", "field", "--free-end", "--certify"], "--free-end"),
        (["--powertrain", "field", "--end-price", "50"], "--end-price"),
        (["--set", "held-in"], "'held-in', allowed train, validation, held-out"),
        (["--set", "held-out", "--trace", "x.csv"], "--trace: not allowed with --set"),
        (["--powertrain", "field", "--soc-final", "0.9"], "0.3..0.8"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(capsys, arguments, message):
    assert main(["dp", *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_rows_come_in_the_order_asked_for_and_a_failure_is_a_row(cycle_files):
    good, bad = (make_scenario("field", path, 0.55, 0.59) for path in cycle_files)
    rows = find_optima([good, bad, good], certified=False, jobs=1)
    assert [row.note is None for row in rows] == [True, False, True]
    assert "cannot be reached" in str(rows[1].note)
    assert rows[0].driven_kg == pytest.approx(rows[0].fuel_kg, rel=5e-3)
    assert rows[0].starts is not None
    assert json.loads(json.dumps(rows[0].to_json())) == rows[0].to_json()


@pytest.mark.slow
def test_processes_find_what_one_finds(cycle_file):
    scenarios = [make_scenario("field", cycle_file, 0.55, soc) for soc in (0.55, 0.56)]
    alone = find_optima(scenarios, certified=True, jobs=1)
    together = find_optima(scenarios, certified=True, jobs=2)
    assert [row.to_json() for row in together] == [row.to_json() for row in alone]


def test_a_set_prints_one_row_per_cycle(capsys, monkeypatch):
    """With the solver left out: rows, exit code and the cycles that are not certified."""
    certificate = {"grid_halving_change": 0.0, "rollout_gap": 0.0, "bracket_width": 0.1}

    def found(scenarios, **_):
        rows = [optimum_set._empty(scenario, None) for scenario in scenarios]
        return [
            optimum_set.OptimumRow(**row.to_json() | {"certificate": certificate | {"ok": k > 0}})
            for k, row in enumerate(rows)
        ]

    names = cycle_names("held_out")[:3]
    monkeypatch.setattr(library, "cycle_names", lambda split: names)
    monkeypatch.setattr(optimum_set, "find_optima", found)
    command = ["dp", "--powertrain", "field", "--set", "held-out", "--certify"]
    assert main([*command, "--json"]) == 3
    out, error = capsys.readouterr()
    results = json.loads(out)["results"]
    assert [row["cycle"] for row in results] == list(names)
    assert {row["split"] for row in results} == {"held_out"}
    assert f"1 of {len(results)} not certified: {results[0]['cycle']}" in error
    assert main(command) == 3
    assert results[-1]["cycle"] in capsys.readouterr().out


def test_a_target_is_needed_for_a_certificate():
    with pytest.raises(ConfigError, match="certificate"):
        find_optimum(FIELD, DEMAND_W, 0.55, None, certified=True)
