"""``ems demo``, the main job end to end: from nodes to bags to policies to unseen cycles."""

import json
import subprocess
import sys

import pytest

from tractor_ems.bags.check import check
from tractor_ems.cli import main
from tractor_sim.duty_cycle.library import cycle_names

TARGET = 0.836


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    out = tmp_path_factory.mktemp("demo") / "out"
    command = [sys.executable, "-m", "tractor_ems.cli", "demo", "--out", str(out), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=900, check=False)
    assert done.returncode == 0, done.stderr
    summary = json.loads((out / "summary.json").read_text())
    assert json.loads(done.stdout) == summary
    return out, summary


def rows(summary, policy):
    return {row["cycle"]: row for row in summary["results"] if row["policy"] == policy}


@pytest.mark.slow
@pytest.mark.timeout(1000)
def test_learned_offline_it_is_near_dp_on_unseen_cycles_and_beats_the_rule_base(demo):
    _, summary = demo
    assert summary["schema"] == 1
    ours, rule_base = rows(summary, "ddqn_counterfactual"), rows(summary, "rule_based")
    assert len(ours) >= 5
    assert set(ours) <= set(cycle_names("validation"))
    for cycle, row in ours.items():
        assert row["transport"] == "ros"
        assert (row["soc_initial"], row["soc_target"]) == (0.85, TARGET)
        assert 0.99 <= row["dp_ratio"] <= 1.0005
        assert row["dp_ratio"] > rule_base[cycle]["dp_ratio"]
        assert abs(row["soc_final"] - TARGET) <= 0.02


@pytest.mark.slow
@pytest.mark.timeout(1000)
def test_every_opponent_stands_beside_it_and_nothing_beats_dp(demo):
    _, summary = demo
    expected = {
        "ddqn_counterfactual",
        "ddqn_sampled",
        "dp",
        "rule_based",
        "best_point",
        "myopic_greedy",
        "conventional",
    }
    cycles = set(rows(summary, "dp"))
    for policy in expected:
        assert set(rows(summary, policy)) == cycles, policy
    for row in summary["results"]:
        assert row["violations"] == 0
        assert row["shortfall_j"] == 0.0
        assert row["dp_ratio"] <= 1.0005


@pytest.mark.slow
@pytest.mark.timeout(1000)
def test_its_bags_pass_every_check_and_its_training_names_them(demo):
    out, summary = demo
    assert {bag["policy"] for bag in summary["bags"]} == {"dp", "rule_based"}
    for bag in summary["bags"]:
        assert bag["cycle"] in cycle_names("train")
        report = check(out / bag["path"])
        failed = [item for item in report.checks if item.outcome == "fail"]
        assert report.verdict == "pass", (bag["path"], failed)
    for facts in summary["training"].values():
        assert len(facts["bags"]) == len(summary["bags"])
        assert (out / facts["policy"]).is_file()
    assert len(list((out / "plots").glob("*.png"))) >= 6


def test_a_folder_that_no_demo_made_is_left_alone(tmp_path, capsys):
    (tmp_path / "thesis.tex").write_text("years of work")
    assert main(["demo", "--out", str(tmp_path)]) == 2
    assert str(tmp_path) in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_folder_that_only_looks_like_a_demos_is_left_alone(tmp_path):
    mine = tmp_path / "bags" / "mine.mcap"
    mine.parent.mkdir()
    mine.write_bytes(b"a season")
    assert main(["demo", "--out", str(tmp_path)]) == 2
    assert mine.read_bytes() == b"a season"
