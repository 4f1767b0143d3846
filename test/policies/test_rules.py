"""The rules do what their names say, on and off their limits."""

import numpy as np
import pytest
from policies.work import FIELD, driven

from tractor_ems.drive import drive
from tractor_ems.policies.genset import best_power_w
from tractor_ems.policies.registry import RULES, make_policy, make_rule, node_of
from tractor_ems.policies.rules import BestPoint, Conventional, MyopicGreedy, RuleBased
from tractor_ems.scenario import make_scenario
from tractor_msgs_py.errors import PolicyError
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


def test_conventional_idles_where_there_is_no_demand():
    demand_w = [50e3, 50e3, 0.0, -20e3, 50e3]
    (on_field,) = driven(Conventional(), demand_w)
    assert on_field.engine_on.all()
    idling = FIELD.engine.curve_fuel_kg_per_s[0]
    np.testing.assert_allclose(on_field.fuel_kg[2:4], idling, rtol=1e-3)
    assert on_field.battery_power_w[3] == pytest.approx(-20e3, abs=2.0)


def test_on_a_plant_with_losses_the_best_point_is_the_one_at_the_bus():
    (on_field,) = driven(BestPoint(FIELD), np.full(20, 140e3))
    assert on_field.engine_power_w[-1] == pytest.approx(best_power_w(FIELD))


@pytest.mark.parametrize(("demand_w", "soc"), [(20e3, 0.77), (240e3, 0.33)])
def test_best_point_stays_off_the_ends_of_the_window_where_the_engine_starts_slowly(demand_w, soc):
    work = np.minimum(np.full(300, demand_w), 60e3 * (1 + np.arange(300)))
    (on_field,) = driven(BestPoint(FIELD), work, soc=soc)
    assert on_field.soc.min() > 0.305 and on_field.soc.max() < 0.795
    np.testing.assert_allclose(on_field.engine_power_w[-1], demand_w, rtol=0.02)
    assert on_field.dissipated_j.sum() == on_field.shortfall_j.sum() == 0.0


def test_the_rule_base_holds_an_engine_that_would_not_be_back_in_time():
    strokes = np.full(300, 40e3)
    strokes[10::25] = 200e3
    held, free = (
        driven(RuleBased(load_powertrain(name)), strokes, params=load_powertrain(name))[0]
        for name in ("field", "field:engine.min_off_s=0,engine.ramp_w_per_s=1.0e9")
    )
    assert held.engine_on[11:].all(), "it idles between the strokes"
    assert not free.engine_on[-1], "an engine that is back at once may stop, as the paper's does"
    assert held.shortfall_j.sum() == free.shortfall_j.sum() == 0.0


@pytest.mark.parametrize("name", RULES)
def test_the_node_of_a_rule_decides_as_the_rule_does(name):
    from tractor_ems.nodes.rule_based_policy import PARAMETERS, prepare

    scenario = make_scenario("field", "planter_1")
    executable, chosen = node_of(name, scenario)
    assert executable == "rule_based_policy"
    values = {parameter.name: parameter.default for parameter in PARAMETERS} | dict(chosen)
    assert prepare(values).policy == make_policy(name, scenario)
    assert make_rule(name, scenario.params).name == name


def test_an_unknown_rule_is_refused_with_the_names_there_are():
    with pytest.raises(PolicyError, match="never_stop_ecms"):
        make_rule("never_stop", FIELD)
