"""Every check fails on the fault it is there for, and a verdict never passes by accident."""

import dataclasses
import json
import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tractor_ems.bags.announced_cycle import compare
from tractor_ems.bags.check import CHECKS, check, first_difference, shipped_powertrain
from tractor_ems.bags.in_process import run_info_of, samples_of, write_demand_bag
from tractor_ems.bags.inspect import info
from tractor_ems.drive import drive
from tractor_ems.policies.rules import RuleBased
from tractor_ems.scenario import Scenario
from tractor_msgs_py.errors import BagError
from tractor_msgs_py.types import (
    BatteryPowerCommand,
    BatteryReading,
    PowerDemand,
    PowertrainReading,
    RunInfo,
)
from tractor_sim.config import load_powertrain
from tractor_sim.duty_cycle.cycle import cycle_hash
from tractor_sim.duty_cycle.generate import generate
from tractor_sim.duty_cycle.library import load_cycle


def changed(samples, kind, k, **values):
    """The samples with fields of the k-th sample of one kind replaced."""
    index = [i for i, sample in enumerate(samples) if isinstance(sample, kind)][k]
    out = list(samples)
    out[index] = dataclasses.replace(out[index], **values)
    return out


def without(samples, kind, k):
    out = list(samples)
    del out[[i for i, sample in enumerate(samples) if isinstance(sample, kind)][k]]
    return out


def failed(report):
    return {item.name for item in report.checks if item.outcome == "fail"}


def test_good_bag_passes_every_check(bag):
    report = check(bag)
    assert report.verdict == "pass"
    assert [item.name for item in report.checks] == list(CHECKS)
    assert {item.outcome for item in report.checks} == {"pass"}
    json.dumps(report.to_json(), allow_nan=False)


@pytest.mark.parametrize(
    ("kind", "values", "expected"),
    [
        (BatteryReading, {"soc": 0.95}, {"soc_limits", "parity"}),
        (PowertrainReading, {"applied_battery_power_w": 260e3}, {"power_limits"}),
        (PowertrainReading, {"applied_engine_power_w": -5.0}, {"power_limits"}),
        (PowertrainReading, {"fuel_kg": 0.5}, {"parity"}),
        (PowertrainReading, {"shortfall_j": 100.0}, {"energy_balance"}),
        (PowertrainReading, {"dissipated_j": 100.0}, {"energy_balance"}),
        (PowerDemand, {"power_w": 123e3}, {"energy_balance", "cycle", "parity"}),
        (PowerDemand, {"power_w": math.nan}, {"values", "complete", "sequence"}),
        (BatteryReading, {"soc": math.inf}, {"values", "complete", "sequence"}),
        (PowertrainReading, {"fuel_kg": math.nan}, {"values", "complete", "sequence"}),
        (BatteryPowerCommand, {"battery_power_w": math.nan}, {"values"}),
        (BatteryPowerCommand, {"battery_power_w": 1e5}, {"parity"}),
        (PowerDemand, {"stamp_ns": 0}, {"stamps", "sequence", "complete"}),
    ],
)
def test_fault_in_one_sample_fails_its_check(driven, write, kind, values, expected):
    report = check(write(changed(driven.samples, kind, 30, **values)))
    assert report.verdict == "fail" and expected <= failed(report)


@pytest.mark.parametrize(
    "kind", [PowerDemand, BatteryReading, PowertrainReading, BatteryPowerCommand]
)
def test_missing_sample_fails_sequence_and_completeness(driven, write, kind):
    report = check(write(without(driven.samples, kind, 30)))
    assert {"sequence", "complete"} <= failed(report)


def test_stamp_off_the_announced_grid_fails(driven, write):
    stamp_ns = driven.info.stamp_ns(30) + 5
    report = check(write(changed(driven.samples, PowerDemand, 30, stamp_ns=stamp_ns)))
    assert "stamps" in failed(report)


def test_aborted_run_fails_completeness_only(driven, write):
    kept = [s for s in driven.samples if isinstance(s, RunInfo) or s.stamp_ns < 1_030 * 10**9]
    assert failed(check(write(kept))) == {"complete"}


def test_parity_is_judged_on_the_given_powertrain(driven, write):
    other = dataclasses.replace(driven.info, powertrain="mine", powertrain_hash="0" * 64)
    path = write([other, *driven.samples[1:]])
    report = check(path)
    assert report.verdict == "pass"
    assert report.outcome("parity") == report.outcome("soc_limits") == "not_applicable"
    assert "parity" in failed(check(path, driven.scenario.params))


def test_demand_only_bag_passes_what_applies(tmp_path):
    write_demand_bag(tmp_path / "bag", 10**9 * np.arange(5, 50), np.full(45, 9e4), "/t")
    report = check(tmp_path / "bag")
    assert report.verdict == "pass"
    skipped = {item.name for item in report.checks if item.outcome == "not_applicable"}
    assert skipped == {
        "complete", "soc_limits", "power_limits", "energy_balance", "cycle", "parity"
    }  # fmt: skip
    (run,) = info(tmp_path / "bag")["runs"]
    assert (run["run_id"], run["demand_samples"], run["driven_steps"]) == (None, 45, 0)


def test_demand_only_bag_with_a_hole_or_jitter_fails(tmp_path):
    stamps = 10**9 * np.arange(5, 50)
    write_demand_bag(tmp_path / "hole", np.delete(stamps, 20), np.full(44, 9e4))
    assert failed(check(tmp_path / "hole")) == {"sequence"}
    late = stamps + np.where(np.arange(45) == 20, 20_000_000, 0)
    write_demand_bag(tmp_path / "late", late, np.full(45, 9e4))
    assert failed(check(tmp_path / "late")) == {"stamps"}


def flipping(examples):
    """Derandomised: one length byte of the file is redundant, and 1 bit of it harmless."""
    return settings(
        max_examples=examples,
        deadline=None,
        derandomize=True,
        suppress_health_check=[HealthCheck.function_scoped_fixture],
    )


@flipping(10)
@given(data=st.data())
def test_no_flipped_bit_passes(bag, tmp_path_factory, data):
    refuse_a_flipped_bit(bag, tmp_path_factory, data)


@pytest.mark.slow
@flipping(40)
@given(data=st.data())
def test_none_of_more_flipped_bits_passes(bag, tmp_path_factory, data):
    refuse_a_flipped_bit(bag, tmp_path_factory, data)


def refuse_a_flipped_bit(bag, tmp_path_factory, data):
    content = bytearray((bag / "bag_0.mcap").read_bytes())
    content[data.draw(st.integers(0, len(content) - 1), "byte")] ^= 1 << data.draw(
        st.integers(0, 7), "bit"
    )
    path = tmp_path_factory.mktemp("flip") / "bag_0.mcap"
    path.write_bytes(content)
    assert check(path).verdict in ("fail", "no data")


def test_unreadable_bag_has_no_data_and_runs_no_check(tmp_path):
    (tmp_path / "bag.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    report = check(tmp_path / "bag.mcap")
    assert report.verdict == "no data"
    assert [item.outcome for item in report.checks] == ["fail"] + ["not_run"] * (len(CHECKS) - 1)


def test_missing_bag_is_an_error(tmp_path):
    with pytest.raises(BagError, match="no such bag"):
        check(tmp_path / "nothing")


def test_info_names_the_run_and_its_hash(bag, driven):
    from tractor_msgs_py.trajectory import trajectory_hash

    document = info(bag)
    (run,) = document["runs"]
    assert run["trajectory_hash"] == trajectory_hash(driven.trajectory)
    assert run["fuel_kg"] == pytest.approx(driven.trajectory.fuel_kg.sum())
    assert run["policy"] == "rule_based" and run["complete"] is True
    assert {topic["name"] for topic in document["topics"]} == {
        "/run_info", "/power_demand", "/battery_state", "/powertrain_state",
        "/battery_power_command",
    }  # fmt: skip


def test_shipped_powertrain_is_found_by_its_hash(driven):
    assert shipped_powertrain(driven.info.powertrain_hash) == driven.scenario.params
    assert shipped_powertrain("0" * 64) is None


def test_first_difference_names_column_and_step(driven):
    other = driven.trajectory.fuel_kg.copy()
    other[7] += 1.0
    text = first_difference(
        driven.trajectory, dataclasses.replace(driven.trajectory, fuel_kg=other)
    )
    assert text.startswith("fuel_kg differs from step 7")
    assert first_difference(driven.trajectory, driven.trajectory) == "no difference"


def test_a_complete_run_of_no_possible_cycle_gets_a_verdict(driven, write):
    """Steps of ten minutes: the demand cannot be any duty cycle, least of all the announced."""
    slow = []
    for sample in driven.samples:
        if isinstance(sample, RunInfo):
            slow.append(dataclasses.replace(sample, dt_s=600.0))
            continue
        ticks = (sample.stamp_ns - driven.info.t0_ns) // driven.info.dt_ns
        stamp_ns = driven.info.t0_ns + ticks * 600 * 10**9
        slow.append(dataclasses.replace(sample, stamp_ns=stamp_ns))
    report = check(write(slow))
    assert report.verdict == "fail" and report.outcome("complete") == "pass"
    assert report.outcome("cycle") == "fail"


def test_a_demand_of_no_tractor_fails_the_values(driven, write):
    report = check(write(changed(driven.samples, PowerDemand, 5, power_w=2e9)))
    assert report.outcome("values") == "fail"


def on_field(cycle, setting=""):
    """Samples of a cycle driven on the field tractor, whose plant adds 4 kW of auxiliaries."""
    params = load_powertrain(f"field{setting}")
    soc = params.soc_initial
    scenario = Scenario(params, cycle, soc, soc, params.name, cycle.name)
    demand_w = scenario.power_demand_w[None, :]
    driven = drive(RuleBased(params), params, demand_w, soc, soc)[0]
    return samples_of(params, run_info_of(scenario, driven, "rule_based"), driven)[0]


def of_cycle(report):
    return next((item.outcome, item.detail) for item in report.checks if item.name == "cycle")


@pytest.fixture(scope="module")
def whole_watts():
    return generate("chisel_plow", 3, duration_s=60)


def test_auxiliaries_come_off_before_the_cycle_is_compared(whole_watts, write):
    report = check(write(on_field(whole_watts)))
    assert report.verdict == "pass"
    assert of_cycle(report) == ("pass", "1 runs, less auxiliaries of 4000 W")


@pytest.mark.parametrize("added_w", [1.0, 1e-6])
def test_one_altered_demand_is_not_the_cycle_with_auxiliaries_either(whole_watts, write, added_w):
    samples = on_field(whole_watts)
    demand_w = float(whole_watts.power_demand_w[30]) + 4000.0
    altered = changed(samples, PowerDemand, 30, power_w=demand_w + added_w)
    assert of_cycle(check(write(altered)))[0] == "fail"


def test_auxiliaries_of_a_broken_watt_come_off_a_cycle_of_whole_watts(whole_watts, write):
    samples = on_field(whole_watts, ":p_aux_w=4000.1")
    assert np.any(whole_watts.power_demand_w + 4000.1 - 4000.1 != whole_watts.power_demand_w)
    assert of_cycle(check(write(samples)))[0] == "pass"


def test_a_listed_cycle_of_broken_watts_is_compared_as_the_plant_added_it_up(driven):
    cycle = load_cycle("planter")
    demand_w = cycle.power_demand_w + 4000.0
    assert np.any(demand_w - 4000.0 != cycle.power_demand_w)
    said = dataclasses.replace(
        driven.info, cycle="planter", cycle_hash=cycle_hash(cycle), p_aux_w=4000.0
    )
    assert compare(demand_w, said) == "same"
    demand_w[30] = np.nextafter(demand_w[30], np.inf)
    assert compare(demand_w, said) == "other"


def test_what_rounding_hides_of_an_unlisted_cycle_is_said_not_guessed(write):
    whole = load_cycle("planter")
    rounded = whole.power_demand_w + 4000.0 - 4000.0 != whole.power_demand_w
    first = int(np.argmax(rounded))
    part_w = whole.power_demand_w[first : first + 20]
    part = dataclasses.replace(whole, name="part", power_demand_w=part_w)
    outcome, why = of_cycle(check(write(on_field(part))))
    assert outcome == "not_applicable" and "rounding" in why
