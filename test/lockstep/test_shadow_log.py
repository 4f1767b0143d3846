"""The shadow log: nothing between equals, a saving where there is one, a file that survives."""

import csv
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tractor_ems.answer import Answerer
from tractor_ems.decide import Applied, DecideConfig
from tractor_ems.evaluate import evaluate
from tractor_ems.nodes.policy_setup import PolicySetup, papers_of
from tractor_ems.policies.q_policy import load_policy
from tractor_ems.policies.registry import policy_file
from tractor_ems.policies.rules import Conventional, RuleBased
from tractor_ems.scenario import make_scenario
from tractor_ems.shadow_log import COLUMNS, Price, ShadowLog, predicted, price_of
from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.observation import Observation
from tractor_msgs_py.types import BatteryPowerCommand
from tractor_sim.config import load_powertrain
from tractor_sim.plant_run import prepare_run

PAPER = load_powertrain("paper")
PRICE = price_of(PAPER)


def shadowed(log, incumbent, shadow, powertrain, cycle):
    """Drive a cycle with one policy while another follows in its shadow."""
    run = prepare_run(powertrain, str(cycle))
    driver = Answerer(incumbent)
    follower = Answerer(shadow, config=DecideConfig(shadow=True, params=run.params))
    for answerer in (driver, follower):
        answerer.start_run(run.info)
    seen = None
    while not run.done:
        command = None
        for sample in run.samples():
            command = driver.observe(sample, lambda: 1, 0.0) or command
            assert follower.observe(sample, lambda: 0, 0.0) is None
        if follower.decision is not seen:
            seen = follower.decision
            log.tick(seen.observation, seen.wish, seen.applied)
        run.apply(command)
    return log


@pytest.fixture
def cycle(tmp_path):
    """Two minutes of work that starts and stops the engine."""
    demand_w = [110e3 + 80e3 * math.sin(second / 5.0) for second in range(120)]
    rows = "".join(f"{second},{power!r}\n" for second, power in enumerate(demand_w))
    path = tmp_path / "two_minutes.csv"
    path.write_text("time_s,power_demand_w\n" + rows)
    return path


@pytest.mark.parametrize("powertrain", ["paper", "field"])
def test_between_equals_there_is_no_difference(powertrain, cycle):
    params = load_powertrain(powertrain)
    log = ShadowLog(params, params.dt_s, price_of(params))
    total = shadowed(log, RuleBased(params), RuleBased(params), powertrain, cycle).sum
    assert total.ticks == 119
    assert total.applied_fuel_kg > 0.1
    assert abs(total.equivalent_difference_kg) < 1e-6 * total.applied_fuel_kg
    assert abs(total.policy_fuel_kg - total.applied_fuel_kg) < 1e-6 * total.applied_fuel_kg
    assert total.measured_fuel_kg == pytest.approx(total.applied_fuel_kg, rel=1e-6)


@pytest.mark.slow
def test_the_shipped_policy_promises_about_what_it_saves():
    policy = load_policy(policy_file("default", "paper"))
    price = price_of(PAPER, policy.reward)
    log = ShadowLog(PAPER, PAPER.dt_s, price)
    total = shadowed(log, RuleBased(PAPER), policy, "paper", "planter").sum
    scenario = make_scenario("paper", "planter")
    rule, _ = evaluate("rule_based", scenario, with_dp=False)
    own, _ = evaluate("default", scenario, with_dp=False)
    energy_j = PAPER.battery.energy_j
    true_kg = own.fuel_kg - rule.fuel_kg
    true_kg += (rule.soc_final - own.soc_final) * energy_j * price.kg_per_j
    print(
        f"predicted {total.equivalent_difference_kg:+.4f} kg, true {true_kg:+.4f} kg, {total.line}"
    )
    assert true_kg < 0.0 and total.equivalent_difference_kg < 0.0
    assert 0.3 < total.equivalent_difference_kg / true_kg < 3.0


def seen(stamp_ns=1_000_000_000, demand_w=100e3, on=False):
    one = np.ones(1)
    return Observation(
        stamp_ns=stamp_ns,
        power_demand_w=demand_w * one,
        soc=0.8 * one,
        soc_target=0.8 * one,
        engine_on=np.array([on]),
        time_in_state_s=100.0 * one,
        engine_power_w=demand_w * one * on,
        charge_limit_w=215e3 * one,
        discharge_limit_w=215e3 * one,
        engine_limit_w=275e3 * one,
        features=np.zeros((1, 0)),
    )


def test_a_start_that_the_policy_has_already_paid_for_is_not_paid_again():
    params = replace(PAPER, engine=replace(PAPER.engine, start_fuel_kg=0.01))
    first = predicted(params, seen(), 0.0, off=False, was_on=False)
    second = predicted(params, seen(), 0.0, off=False, was_on=True)
    assert first.fuel_kg - second.fuel_kg == pytest.approx(0.01)


def test_battery_energy_is_priced_and_a_gap_is_not_compared():
    log = ShadowLog(PAPER, 1.0, Price(1e-7, 0.0, "a test"))
    applied = Applied(engine_power_w=100e3)
    for second in (1, 2, 4, 5):
        stamp_ns = second * 1_000_000_000
        log.tick(seen(stamp_ns, on=True), BatteryPowerCommand(stamp_ns, 20e3), applied)
    total = log.sum
    assert total.ticks == 2 and total.measured_ticks == 0
    assert total.battery_difference_j == pytest.approx(2 * 20e3)
    saved_kg = total.applied_fuel_kg - total.policy_fuel_kg
    assert saved_kg > 0.0
    assert total.equivalent_difference_kg == pytest.approx(2 * 20e3 * 1e-7 - saved_kg)


def test_the_file_says_where_it_comes_from_and_sums_up_beside_it(tmp_path, cycle):
    path = tmp_path / "log" / "shadow.csv"
    log = ShadowLog(PAPER, 1.0, PRICE, path, {"policy": "rules"})
    total = shadowed(log, RuleBased(PAPER), Conventional(), "paper", cycle).sum
    log.close()
    lines = path.read_text().splitlines()
    header = [line for line in lines if line.startswith("#")]
    assert "# policy: rules" in header and any("best specific fuel" in line for line in header)
    rows = list(csv.DictReader(lines[len(header) :]))
    assert tuple(rows[0]) == COLUMNS and len(rows) == total.ticks
    together = math.fsum(float(row["equivalent_difference_kg"]) for row in rows)
    document = json.loads(path.with_suffix(".json").read_text())
    assert document["sum"]["equivalent_difference_kg"] == pytest.approx(together)
    assert document["about"]["policy"] == "rules"
    assert total.line.startswith(f"shadow: {total.ticks} ticks")


def test_what_was_flushed_is_there_without_an_end(tmp_path):
    path = tmp_path / "shadow.csv"
    log = ShadowLog(PAPER, 1.0, PRICE, path)
    for second in (1, 2, 3):
        stamp_ns = second * 1_000_000_000
        log.tick(seen(stamp_ns), BatteryPowerCommand(stamp_ns, 0.0), Applied(engine_power_w=1e5))
    log.flush(now_s=5.0)
    assert len([x for x in path.read_text().splitlines() if x[0].isdigit()]) == 2
    log.close()


def test_a_place_that_cannot_be_written_is_refused_by_name(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match=r"parameter shadow_log: .*file/shadow.csv"):
        ShadowLog(PAPER, 1.0, PRICE, tmp_path / "file" / "shadow.csv")


def test_a_disk_that_is_full_ends_the_file_and_not_the_drive(tmp_path):
    with pytest.raises(ConfigError, match="No space left"):
        ShadowLog(PAPER, 1.0, PRICE, Path("/dev/full"))
    log = ShadowLog(PAPER, 1.0, PRICE, tmp_path / "shadow.csv")
    log._file.close()
    with Path("/dev/full").open("w", buffering=1) as log._file:
        for second in (1, 2, 3):
            stamp_ns, applied = second * 1_000_000_000, Applied(engine_power_w=1e5)
            log.tick(seen(stamp_ns), BatteryPowerCommand(stamp_ns, 0.0), applied)
            log.flush(now_s=2.0 * second)
    assert log.sum.ticks == 2 and "No space left" in log.trouble
    log.close()
    assert json.loads((tmp_path / "shadow.json").read_text())["sum"]["ticks"] == 2


@pytest.mark.parametrize(
    ("shadow_log", "report", "named"),
    [("d.json", "", "shadow_log: d.json"), ("d.csv", "d.json", "report: d.json")],
)
def test_two_papers_do_not_share_a_file(shadow_log, report, named):
    values = {"shadow_log": shadow_log, "report": report, "shadow": True}
    with pytest.raises(ConfigError, match=named):
        papers_of(PolicySetup(RuleBased(PAPER), params=PAPER), None, values)


def test_a_report_says_from_the_beginning_that_the_drive_has_not_ended(tmp_path):
    values = {"shadow_log": "", "report": str(tmp_path / "report.json"), "shadow": False}
    papers_of(PolicySetup(RuleBased(PAPER), params=PAPER), None, values)
    assert json.loads((tmp_path / "report.json").read_text())["ended"] is False
    values["report"] = "/dev/null/report.json"
    with pytest.raises(ConfigError, match=r"/dev/null/report.json: cannot be written"):
        papers_of(PolicySetup(RuleBased(PAPER), params=PAPER), None, values)
