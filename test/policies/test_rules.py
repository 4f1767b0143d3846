"""The rules do what their names say, on and off their limits."""

import numpy as np
import pytest

from tractor_ems.drive import drive
from tractor_ems.policies.rules import BestPoint, Conventional, MyopicGreedy, RuleBased
from tractor_sim.config import load_powertrain

PAPER = load_powertrain("paper")


def run(policy, demand_w, soc=0.8):
    return drive(policy, PAPER, np.asarray(demand_w, dtype=float)[None, :], soc, 0.8)[0]


def test_conventional_burns_for_the_load_and_leaves_the_battery_alone():
    trajectory = run(Conventional(), [20e3, 150e3, 270e3])
    np.testing.assert_array_equal(trajectory.engine_power_w, [20e3, 150e3, 270e3])
    assert trajectory.soc_final == 0.8


def test_conventional_is_helped_only_above_the_engines_maximum():
    trajectory = run(Conventional(), [300e3])
    assert trajectory.engine_power_w[0] == 275e3
    assert trajectory.battery_power_w[0] == pytest.approx(25e3)


def test_best_point_holds_the_engine_where_it_is_best():
    trajectory = run(BestPoint(PAPER), [50e3, 150e3, 260e3])
    np.testing.assert_allclose(trajectory.engine_power_w, 150e3)


def test_best_point_gives_way_to_a_full_battery():
    trajectory = run(BestPoint(PAPER), np.full(5, 50e3), soc=0.9)
    np.testing.assert_allclose(trajectory.engine_power_w, 50e3)
    assert trajectory.soc_final <= 0.9


def test_rule_base_runs_the_engine_above_110_kw_only():
    trajectory = run(RuleBased(PAPER), [109e3, 110e3, 111e3, 200e3, 60e3])
    np.testing.assert_array_equal(trajectory.engine_power_w, [0, 0, 111e3, 200e3, 0])
    np.testing.assert_array_equal(trajectory.engine_on, [False, False, True, True, False])


def test_the_soc_guard_recharges_with_hysteresis_and_can_be_switched_off():
    demand_w = np.full(250, 100e3)
    guarded = run(RuleBased(PAPER), demand_w, soc=0.712)
    assert guarded.soc.min() >= 0.709
    assert np.count_nonzero(np.diff(guarded.engine_on.astype(int)) == 1) == 1
    empty = run(RuleBased(PAPER, soc_guard=False), np.full(600, 100e3), soc=0.712)
    assert empty.soc.min() == pytest.approx(0.7, abs=1e-4)
    assert empty.shortfall_j.sum() == 0.0, "the plant starts the engine when the battery is empty"


def test_myopic_greedy_never_pays_for_its_future():
    trajectory = run(MyopicGreedy(PAPER), np.full(50, 160e3))
    used = trajectory.engine_power_w[trajectory.engine_power_w > 0]
    assert trajectory.soc_final < 0.8
    np.testing.assert_allclose(used, 150e3, atol=400)
