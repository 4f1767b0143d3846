"""A result row is computed from the trajectory alone, and its violation count can fail."""

import dataclasses

import numpy as np
import pytest

from tractor_ems.drive import drive
from tractor_ems.evaluate import evaluate
from tractor_ems.policies.rules import BestPoint, Conventional, MyopicGreedy, RuleBased
from tractor_ems.result import count_violations, summarise
from tractor_ems.scenario import make_scenario
from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.trajectory import trajectory_hash
from tractor_sim.config import load_powertrain
from tractor_sim.duty_cycle.cycle import cycle_hash
from tractor_sim.duty_cycle.library import load_cycle
from tractor_sim.fuel import gallons

PAPER = load_powertrain("paper")
PLANTER = load_cycle("planter")


def driven(policy, cycle=PLANTER):
    return drive(policy, PAPER, cycle.power_demand_w[None, :], 0.85, 0.836)[0]


def row(trajectory, cycle=PLANTER):
    return summarise(
        trajectory,
        policy="p",
        cycle=cycle,
        params=PAPER,
        soc_target=0.836,
        transport="in_process",
        dp_ratio=None,
    )


def test_a_row_adds_up():
    result = row(driven(Conventional()))
    assert result.steps == 766
    assert result.fuel_gal == pytest.approx(gallons(result.fuel_kg))
    assert gallons(0.8375 * 3.785411784) == pytest.approx(1.0)
    assert result.efficiency * result.fuel_kg * 42.8e6 == pytest.approx(
        PLANTER.power_demand_w.sum(), rel=1e-9
    )
    assert (result.soc_initial, result.soc_final, result.engine_starts) == (0.85, 0.85, 1)
    assert result.violations == 0
    assert not result.held_out


def test_a_held_out_cycle_is_marked():
    cycle = load_cycle("rotary_hoe_2001")
    assert row(driven(Conventional(), cycle), cycle).held_out


def test_a_cycle_that_the_policy_was_trained_on_is_not_held_out_for_it():
    cycle = load_cycle("rotary_hoe_2001")
    result = summarise(
        driven(Conventional(), cycle),
        policy="p",
        cycle=cycle,
        params=PAPER,
        soc_target=0.836,
        transport="in_process",
        dp_ratio=None,
        trained_on=[cycle_hash(cycle)],
    )
    assert not result.held_out


def test_a_run_that_dp_cannot_judge_is_reported_with_the_reason(monkeypatch):
    def refuse(*_):
        raise ConfigError("grid: too coarse for this test")

    monkeypatch.setattr("tractor_ems.evaluate.dp_ratio", refuse)
    result, _ = evaluate("rule_based", make_scenario("paper", "planter_1"))
    assert result.dp_ratio is None
    assert result.dp_note == "grid: too coarse for this test"
    assert result.fuel_kg > 0.0


@pytest.mark.parametrize(
    ("column", "value"),
    [
        ("battery_power_w", 260e3),
        ("engine_power_w", 276e3),
        ("engine_power_w", -1.0),
        ("fuel_kg", np.nan),
        ("fuel_kg", 0.5),
        ("fuel_kg", -0.001),
        ("shortfall_j", 500.0),
        ("shortfall_j", np.nan),
        ("dissipated_j", -500.0),
        ("power_demand_w", np.nan),
    ],
)
def test_every_kind_of_violation_is_counted(column, value):
    trajectory = driven(RuleBased(PAPER))
    values = getattr(trajectory, column).copy()
    values[100] = value
    assert count_violations(dataclasses.replace(trajectory, **{column: values}), PAPER) == 1


@pytest.mark.parametrize("soc", [0.9001, 0.6999, 0.86, np.nan])
def test_a_soc_that_no_power_explains_breaks_the_steps_on_either_side(soc):
    trajectory = driven(RuleBased(PAPER))
    values = trajectory.soc.copy()
    values[100] = soc
    assert count_violations(dataclasses.replace(trajectory, soc=values), PAPER) == 2


@pytest.mark.parametrize("policy", [RuleBased(PAPER), BestPoint(PAPER), MyopicGreedy(PAPER)])
def test_the_hash_is_repeatable_and_feels_one_bit(policy):
    trajectory = driven(policy)
    assert trajectory_hash(driven(policy)) == trajectory_hash(trajectory)
    changed = trajectory.fuel_kg.copy()
    changed[7] = np.nextafter(changed[7], 1.0)
    other = dataclasses.replace(trajectory, fuel_kg=changed)
    assert trajectory_hash(other) != trajectory_hash(trajectory)


def test_a_batch_drives_like_its_members():
    demand_w = np.stack([load_cycle(f"planter_{seed}").power_demand_w for seed in (1, 2, 3)])
    together = drive(RuleBased(PAPER), PAPER, demand_w, np.array([0.85, 0.75, 0.703]), 0.8)
    for b, soc in enumerate((0.85, 0.75, 0.703)):
        alone = drive(RuleBased(PAPER), PAPER, demand_w[b : b + 1], soc, 0.8)[0]
        assert trajectory_hash(together[b]) == trajectory_hash(alone)
