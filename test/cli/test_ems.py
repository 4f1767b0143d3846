"""``ems`` answers programs with one JSON document and bad input with one line and exit code 2."""

import json

import numpy as np
import pytest

from tractor_ems.cli import main
from tractor_sim.duty_cycle.cycle_csv import write_cycle_csv
from tractor_sim.duty_cycle.library import load_cycle

RESULT_FIELDS = {
    "policy": str,
    "cycle": str,
    "powertrain": str,
    "held_out": bool,
    "fuel_kg": float,
    "fuel_gal": float,
    "efficiency": float,
    "soc_initial": float,
    "soc_final": float,
    "soc_target": float,
    "engine_starts": int,
    "shortfall_j": float,
    "violations": int,
    "dp_ratio": float,
    "steps": int,
    "trajectory_hash": str,
    "transport": str,
}


def document(capsys, *argv):
    assert main([*argv, "--json"]) == 0
    captured = capsys.readouterr()
    return json.loads(captured.out)


def refusal(capsys, *argv):
    assert main([*argv]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1, captured.err
    return captured.err


@pytest.mark.parametrize(
    "policy",
    [
        "rule_based",
        "dp",
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in ("conventional", "best_point", "myopic_greedy")
        ),
    ],
)
def test_evaluate_prints_one_bare_result(capsys, policy):
    result = document(capsys, "evaluate", "--policy", policy, "--cycle", "planter_1001")
    for field, kind in RESULT_FIELDS.items():
        assert type(result[field]) is kind, field
    assert result["policy"] == policy
    assert result["held_out"] is True
    assert result["violations"] == 0
    assert result["soc_target"] == result["soc_initial"] == 0.85
    assert result["dp_ratio"] <= 1.0005


def test_the_rule_bases_soc_guard_can_be_switched_off(capsys):
    drive = ("evaluate", "--policy", "rule_based", "--soc0", "0.703", "--cycle", "planter")
    guarded, bare = document(capsys, *drive), document(capsys, *drive, "--no-soc-guard")
    assert guarded["trajectory_hash"] != bare["trajectory_hash"]
    assert guarded["soc_final"] > bare["soc_final"]


def test_the_default_policy_ships_and_drives(capsys):
    result = document(capsys, "evaluate", "--cycle", "planter_1001", "--soc-target", "0.836")
    assert result["policy"] == "ddqn_counterfactual"
    assert result["dp_ratio"] >= 0.99
    assert abs(result["soc_final"] - 0.836) <= 0.02


@pytest.mark.slow
def test_dp_ends_where_it_is_told_and_certifies(capsys):
    result = document(
        capsys, "dp", "--cycle", "planter", "--soc0", "0.85", "--soc-final", "0.836", "--certify"
    )
    assert result["soc_final"] == pytest.approx(0.836, abs=1e-4)
    certificate = result["certificate"]
    assert 0 <= certificate["grid_halving_change"] < 0.0005
    assert abs(certificate["rollout_gap"]) < 0.001
    assert certificate["soc_points"] >= 401


def test_a_held_out_cycle_in_a_file_is_still_held_out(capsys, tmp_path):
    path = tmp_path / "mine.csv"
    write_cycle_csv(path, load_cycle("rotary_hoe_2001"))
    assert document(capsys, "evaluate", "--policy", "conventional", "--cycle", str(path))[
        "held_out"
    ]


def test_a_csv_cycle_is_driven_and_shortfall_scores_null(capsys, tmp_path):
    path = tmp_path / "field.csv"
    rows = "\n".join(f"{k},{power}" for k, power in enumerate([50e3, 600e3, 80e3]))
    path.write_text(f"time_s,power_demand_w\n{rows}\n")
    result = document(capsys, "evaluate", "--policy", "conventional", "--cycle", str(path))
    assert result["cycle"] == "field"
    assert result["shortfall_j"] == pytest.approx(75e3)
    assert result["dp_ratio"] is None


def test_a_cycle_is_shown_with_its_samples(capsys):
    shown = document(capsys, "cycle", "show", "planter")
    np.testing.assert_array_equal(shown["power_demand_w"], load_cycle("planter").power_demand_w)


@pytest.mark.parametrize(
    ("argv", "named"),
    [
        (["evaluate", "--policy", "ddpn"], "ddpn"),
        (["evaluate", "--policy", "missing.safetensors"], "missing.safetensors"),
        (["evaluate", "--policy", "dp", "--cycle", "planter_5000"], "planter_5000"),
        (["evaluate", "--policy", "dp", "--cycle", "missing.csv"], "missing.csv"),
        (["evaluate", "--policy", "dp", "--powertrain", "papre"], "papre"),
        (["evaluate", "--policy", "dp", "--soc0", "85"], "0.7..0.9"),
        (["evaluate", "--policy", "dp", "--soc0", "nan"], "nan"),
        (["evaluate", "--policy", "dp", "--transport", "tcp"], "tcp"),
        (["evaluate", "--policy", "dp", "--soc0", "high"], "--soc0"),
        (["dp", "--soc-final", "0.2"], "0.2"),
        (
            ["dp", "--cycle", "short.csv", "--soc0", "0.85", "--soc-final", "0.8"],
            "cannot be reached",
        ),
        (["dp", "--soc-fnal", "0.8"], "--soc-fnal"),
        (["bag", "check", "nowhere"], "nowhere"),
        (["bag", "info", "nowhere"], "nowhere"),
        (["bag", "recover", "nowhere"], "nowhere"),
        (["bag", "transitions", "nowhere"], "nowhere"),
        (["train", "--bags", "nowhere", "--out", "x.safetensors"], "nowhere"),
        (["harvest"], "harvest"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(capsys, tmp_path, monkeypatch, argv, named):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "short.csv").write_text("time_s,power_demand_w\n0,1e5\n1,1e5\n2,1e5\n")
    assert named in refusal(capsys, *argv)
    assert [path.name for path in tmp_path.iterdir()] == ["short.csv"], "nothing half-written"
