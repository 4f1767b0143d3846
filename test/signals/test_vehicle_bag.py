"""A bag of a vehicle with other topics, units and rates: listed, checked, learned from, driven."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from signals.vehicle_bag import vehicle_run

from tractor_ems.bags.sampled_traces import iter_sampled_traces
from tractor_ems.bags.transitions import iter_traces
from tractor_ems.cli import main
from tractor_ems.learning.config import CounterfactualConfig, step_discount, step_target_rate
from tractor_ems.learning.recordings import held_out_name_of, read_recordings
from tractor_ems.policies.q_policy import load_policy
from tractor_ems.signals.config import load_signal_map
from tractor_msgs_py.observation import SAMPLED_SIGNALS
from tractor_sim.config import load_powertrain
from tractor_sim.duty_cycle.library import load_cycle

ROOT = Path(__file__).resolve().parents[2]
GOLDEN = ROOT / "bags" / "vehicle_planter"
MAP = ("--signals", "example_vehicle")
AT_10_HZ = ("--powertrain", "paper:dt_s=0.1")


def slow(*values):
    return pytest.param(*values, marks=pytest.mark.slow)


def run(capsys, *argv):
    code = main([*map(str, argv), "--json"])
    return code, json.loads(capsys.readouterr().out)


def refusal(capsys, *argv):
    assert main([str(word) for word in argv]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1, captured.err
    return captured.err


def changed_map(tmp_path, *changes):
    text = (ROOT / "config" / "signals_example_vehicle.yaml").read_text(encoding="utf-8")
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / "map.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_every_topic_is_listed_with_its_rate_and_its_numbers(capsys):
    code, document = run(capsys, "bag", "signals", GOLDEN)
    assert code == 0
    topics = {topic["topic"]: topic for topic in document["topics"]}
    assert len(topics) == 7
    soc = topics["/tractor1/bms/soc_percent"]
    assert soc["rate_hz"] == pytest.approx(1.0, rel=0.01) and soc["messages"] == 60
    assert 0.0 < soc["jitter_s"] < 0.005
    assert set(topics["/tractor1/genset/state"]["fields"]) == {
        "effort[engine_running]",
        "effort[electric_power_kw]",
    }
    guesses = {(c["signal"], c["scale"], c["sign"]) for c in document["candidates"]}
    assert {("soc", 0.01, 1), ("engine_power_w", 1000.0, 1), ("battery_power_w", 1.0, -1)} <= (
        guesses
    )
    assert all(guess["reason"] for guess in document["candidates"])


@pytest.mark.slow
def test_the_draft_of_a_map_is_the_map_that_was_made_by_hand(capsys, tmp_path):
    draft = tmp_path / "draft.yaml"
    assert run(capsys, "bag", "signals", GOLDEN, "--out", draft)[0] == 0
    assert "exists already" in refusal(capsys, "bag", "signals", GOLDEN, "--out", draft)
    by_hand = load_signal_map("example_vehicle")
    assert set(load_signal_map(draft).names) == set(by_hand.names)
    (drafted,) = iter_sampled_traces([GOLDEN], load_signal_map(draft), 0.1)
    (made,) = iter_sampled_traces([GOLDEN], by_hand, 0.1)
    for column in ("power_demand_w", "soc", "battery_power_w", "engine_power_w", "engine_on"):
        # The drafted sum has its terms in another order.
        np.testing.assert_allclose(getattr(drafted, column), getattr(made, column), rtol=1e-12)


def test_a_bag_that_fits_its_map_passes_the_check(capsys):
    code, report = run(capsys, "bag", "check", GOLDEN, *MAP)
    assert code == 0 and report["verdict"] == "pass" and report["namespace"] == "/tractor1"
    signals = {item["signal"]: item for item in report["signals"]}
    assert [round(signals[name]["rate_hz"]) for name in ("power_demand_w", "soc")] == [10, 1]
    assert all(item["covered"] and item["fresh"] == 1.0 for item in report["signals"])
    balance = next(item for item in report["findings"] if item["name"] == "power_balance")
    assert balance["outcome"] == "pass"


@pytest.mark.parametrize(
    ("old", "new", "where", "says"),
    [
        ("scale: 0.01\n", "scale: 1\n", "soc", "looks like percent, which needs scale: 0.01"),
        ("sign: -1\n", "sign: 1\n", "power_balance", "sign: -1 in the map"),
        slow("bms/soc_percent", "bms/soc", "soc", "not in the bag: /tractor1/bms/soc"),
        slow("scale: 1000.0\n", "scale: 1.0\n", "power_balance", "off by"),
        slow("effort[1]", "effort[7]", "engine_power_w", "of genset/state holds effort[7]"),
        slow("max_age_s: 3.0", "max_age_s: 0.2", "soc", "older than its max_age_s"),
    ],
)
def test_a_map_that_does_not_fit_is_told_why(capsys, tmp_path, old, new, where, says):
    wrong = changed_map(tmp_path, (old, new))
    code, report = run(capsys, "bag", "check", GOLDEN, "--signals", wrong)
    found = {item["signal"]: item for item in report["signals"]}
    found |= {item["name"]: item for item in report["findings"]}
    assert says in found[where]["detail"]
    assert found[where]["outcome"] != "pass"
    assert code == (2 if any(item["outcome"] == "fail" for item in found.values()) else 0)


def test_words_that_do_not_fit_together_are_refused(capsys):
    assert "beside --signals" in refusal(capsys, "bag", "check", GOLDEN, "--dt", "1")
    assert "--dt: 1e-09" in refusal(capsys, "bag", "check", GOLDEN, *MAP, "--dt", "1e-9")
    out = "x.safetensors"
    text = refusal(capsys, "train", "--bags", GOLDEN, "--out", out)
    assert "other topics need --signals" in text
    text = refusal(capsys, "train", "--bags", GOLDEN, "--out", out, "--namespace", "/a")
    assert "namespace" in text
    assert "in_process" in refusal(capsys, "evaluate", *MAP, "--transport", "ros")


def test_a_discount_and_a_target_rate_are_of_a_second():
    config = CounterfactualConfig()
    assert step_discount(config, 1.0) == config.gamma
    assert step_discount(config, 0.1) ** 10 == pytest.approx(config.gamma)
    assert step_target_rate(config, 1.0) == config.target_rate
    assert step_target_rate(config, 0.1) == pytest.approx(10 * config.target_rate)


def test_the_traces_of_a_vehicle_are_the_drive_that_it_recorded():
    scenario, trajectory = vehicle_run(seconds=60, first=100)
    (trace,) = iter_sampled_traces([GOLDEN], load_signal_map("example_vehicle"), 0.1, driven=True)
    # What is stamped within a period is known at its end: step k is that of tick k - 1.
    offset = round((int(trace.stamp_ns[0]) - int(trajectory.stamp_ns[0])) / 1e8) - 1
    assert 0 <= offset <= 10, "it begins with the first second's SOC"
    for column, tolerance_w in (("power_demand_w", 1e-6), ("battery_power_w", 9e3)):
        true_w = getattr(trajectory, column)[offset : offset + len(trace)]
        off_w = np.abs(getattr(trace, column)[: len(true_w)] - true_w)
        assert np.median(off_w) <= tolerance_w, column
    assert trace.soc is not None and trace.fuel_kg is not None
    assert np.max(np.abs(trace.soc[: len(trace)] - scenario.soc_initial)) < 0.01
    burnt_kg = trajectory.fuel_kg[offset : offset + len(trace)].sum()
    assert trace.fuel_kg.sum() == pytest.approx(burnt_kg, rel=0.02)


@pytest.mark.parametrize(("begin", "end"), [(0, None), (3, None), (7, -4), (12, -13)])
def test_a_held_out_cycle_is_known_by_its_content_at_ten_times_its_rate(begin, end):
    (trace,) = iter_traces([ROOT / "bags" / "demand_only"])
    held_out_w = load_cycle("rotary_hoe_2001").power_demand_w
    # Auxiliaries and the rounding of a product of sensors are in it.
    fine_w = np.repeat(held_out_w, 10)[begin:end] * (1.0 + 1e-15) + 4000.0
    stamps = np.arange(len(fine_w)) * 10**8
    whole = replace(trace, stamp_ns=stamps, power_demand_w=fine_w, dt_s=0.1)
    assert held_out_name_of(whole) == ("rotary_hoe_2001" if begin < 10 else None)
    assert held_out_name_of(replace(whole, cycle="rotary_hoe_77")) is not None
    assert held_out_name_of(trace) is None


@pytest.mark.slow
def test_a_bag_becomes_a_cycle(capsys, tmp_path):
    out = tmp_path / "cycle.csv"
    code, account = run(capsys, "cycle", "import", GOLDEN, *MAP, "--out", out, "--dt", "0.1")
    assert code == 0 and account["steps"] in (599, 600)
    _, shown = run(capsys, "cycle", "show", out)
    _, trajectory = vehicle_run(seconds=60, first=100)
    assert shown["mean_w"] == pytest.approx(trajectory.power_demand_w.mean(), rel=1e-3)
    text = refusal(capsys, "cycle", "import", out, *MAP, "--out", tmp_path / "again.csv")
    assert "--signals is for bags" in text


@pytest.mark.slow
def test_a_policy_learns_from_a_vehicle_and_drives_it_near_the_optimum(capsys, tmp_path):
    policy = tmp_path / "policy.safetensors"
    trained = ("--updates", 800, "--out", policy)
    code, report = run(capsys, "train", "--bags", GOLDEN, *MAP, *AT_10_HZ, *trained)
    assert code == 0 and report["details"]["demand_ticks"] > 550
    spec = load_policy(policy).spec
    assert (spec.mode, spec.dt_s, spec.signals) == ("sampled", 0.1, SAMPLED_SIGNALS)
    ways = {way.signal: (way.how, way.max_age_s) for way in spec.sampling}
    assert ways["battery_power_w"] == ("mean", 0.5) and ways["soc"] == ("last", 3.0)
    assert "signals" in load_policy(policy).metadata
    driven = ("evaluate", "--policy", policy, *AT_10_HZ, "--cycle", GOLDEN, *MAP)
    code, result = run(capsys, *driven)
    assert code == 0 and result["violations"] == 0
    assert 0.97 < result["dp_ratio"] <= 1.0001


@pytest.mark.slow
def test_targets_sampled_learn_from_a_vehicle_too(capsys, tmp_path):
    policy = tmp_path / "policy.safetensors"
    trained = ("--targets", "sampled", "--updates", 50, "--out", policy)
    code, report = run(capsys, "train", "--bags", GOLDEN, *MAP, *AT_10_HZ, *trained)
    assert code == 0 and report["details"]["seeding"]["dp"]["seeded"] > 500


def test_renaming_nothing_keeps_the_map_out_of_an_exact_policy():
    empty = read_recordings([ROOT / "bags" / "demand_only"], [], load_powertrain("paper"))
    assert empty.signals is None and set(empty.identity) == {"dp_bag_hashes", "rule_bag_hashes"}
    through_a_map = replace(empty, signals=load_signal_map())
    assert through_a_map.identity["signals"]["vehicle"] == "tractor_ems"
