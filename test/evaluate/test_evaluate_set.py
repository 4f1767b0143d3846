"""Many runs: rows in the order asked for, however many processes, and none is ever dropped."""

import numpy as np
import pytest
from evaluate.deadly import make_or_die

from tractor_ems.evaluate_set import FailedRun, Options, evaluate_all, pairs
from tractor_ems.result import Result
from tractor_ems.scenario import Scenario
from tractor_ems.summary import summarise_policies
from tractor_msgs_py.trajectory import trajectory_hash
from tractor_sim.config import load_powertrain
from tractor_sim.duty_cycle.cycle import DutyCycle

PAPER = load_powertrain("paper")
UNSCORED = Options(with_dp=False)


def scenario(name, demand_w=(100e3,) * 20):
    cycle = DutyCycle(name, np.array(demand_w, float), 1.0, "test", split="held_out")
    return Scenario(PAPER, cycle, 0.85, 0.85, "paper", name)


RUNS = pairs(["conventional", "no_such_policy", "best_point"], [scenario(c) for c in "abc"])


def test_rows_come_in_the_order_asked_for_whatever_the_number_of_processes():
    seen = []
    alone = evaluate_all(RUNS, UNSCORED, jobs=1)
    together = evaluate_all(RUNS, UNSCORED, jobs=2, progress=seen.append)
    assert [row.to_json() for row in alone] == [row.to_json() for row in together]
    assert seen == list(range(1, 10))
    documents = [row.to_json() for row in alone]
    names = [(row["cycle"], row["policy"]) for row in documents]
    assert names == [(run.scenario.cycle.name, run.policy) for run in RUNS]


def test_a_run_that_cannot_be_made_is_a_row_that_says_why():
    rows = evaluate_all(RUNS[:3], UNSCORED, jobs=1)
    assert isinstance(rows[0], Result) and isinstance(rows[2], Result)
    assert isinstance(rows[1], FailedRun)
    failed, made = rows[1].to_json(), rows[0].to_json()
    assert failed.keys() == made.keys()
    assert failed["dp_ratio"] is None and failed["fuel_kg"] is None
    assert "no_such_policy" in failed["dp_note"]
    assert (failed["cycle"], failed["split"], failed["held_out"]) == ("a", "held_out", True)


def test_any_exception_is_a_row_too():
    broken = scenario("broken", [100e3, 100e3])
    broken.cycle.power_demand_w[1] = np.nan  # behind the back of its own check
    (row,) = evaluate_all(pairs(["dp"], [broken]), UNSCORED, jobs=1)
    assert isinstance(row, FailedRun)
    assert "broken" in str(row)


def test_a_run_that_kills_its_process_leaves_the_others():
    runs = pairs(["conventional", "deadly", "best_point"], [scenario(c) for c in "ab"])
    rows = evaluate_all(runs, UNSCORED, jobs=2, make=make_or_die)
    assert [isinstance(row, FailedRun) for row in rows] == [False, True, False] * 2
    assert "killed" in rows[1].to_json()["dp_note"]


def test_shortfall_has_no_score_and_counts_as_failed_in_the_summary(monkeypatch):
    monkeypatch.setattr("tractor_ems.evaluate.dp_ratio", lambda *_: 0.99)
    runs = pairs(["conventional"], [scenario("fine"), scenario("short", [50e3, 600e3, 80e3])])
    documents = [row.to_json() for row in evaluate_all(runs, Options(), jobs=1)]
    assert documents[1]["dp_ratio"] is None
    assert "shortfall" in documents[1]["dp_note"]
    (summary,) = summarise_policies(documents)
    assert (summary.runs, summary.scored, summary.short, summary.not_driven) == (2, 1, 1, 0)
    assert summary.dp_ratio_worst == documents[0]["dp_ratio"] == 0.99
    assert summary.worst_cycle == "fine"


def test_a_summary_tells_the_median_from_the_worst():
    base = evaluate_all(pairs(["conventional"], [scenario("a")]), UNSCORED, jobs=1)[0].to_json()
    ratios = {"a": 0.99, "b": 0.95, "c": 0.98, "d": None}
    deviations = {"a": 0.01, "b": -0.03, "c": 0.02, "d": 0.0}
    rows = [
        base | {"cycle": c, "dp_ratio": r, "soc_deviation": deviations[c]}
        for c, r in ratios.items()
    ]
    rows.append(FailedRun(RUNS[0], "no reason").to_json())
    rows.append(base | {"policy": "other"})
    first, other = summarise_policies(rows)
    assert (first.policy, first.runs, first.not_driven) == ("conventional", 5, 1)
    assert (first.dp_ratio_median, first.dp_ratio_worst, first.worst_cycle) == (0.98, 0.95, "b")
    assert first.soc_deviation == -0.03
    assert (other.policy, other.dp_ratio_median, other.worst_cycle) == ("other", None, None)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["load_levelling", "never_stop_ecms"])
def test_ros_and_in_process_are_one_trajectory_on_the_field_plant(name):
    from tractor_ems.evaluate import evaluate
    from tractor_ems.scenario import make_scenario

    run = make_scenario("field", "nrtc_1_256")
    hashes = {
        trajectory_hash(evaluate(name, run, transport=transport, with_dp=False)[1])
        for transport in ("in_process", "ros")
    }
    assert len(hashes) == 1
