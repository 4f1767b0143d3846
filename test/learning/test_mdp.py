"""The compiled decision process equals the production plant, action grid and rewards."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tractor_ems.learning import mdp as mdp_module
from tractor_ems.learning.mdp import (
    Mdp,
    advance,
    battery_power_w,
    bounds_w,
    feasible_actions,
    make_mdp,
    reward_of,
)
from tractor_ems.learning.rewards import RewardConfig, RewardKind, best_fuel_kg, step_reward
from tractor_ems.policies.action_grid import feasible_range
from tractor_msgs_py.errors import ConfigError
from tractor_sim.config import load_powertrain
from tractor_sim.powertrain import (
    Command,
    feasible_battery_power_w,
    initial_state,
    power_limits,
    step,
)

PAPER = load_powertrain("paper")
SOC_TARGET = 0.836

DEMAND_W = st.floats(-100e3, 600e3) | st.sampled_from([0.0, 110e3, 190e3, 250e3, 275e3, 525e3])
SOC = st.floats(PAPER.battery.soc_min, PAPER.battery.soc_max) | st.sampled_from(
    [0.70, 0.70 + 1e-9, 0.7001, 0.85, 0.8999, 0.90]
)
COMPILED = settings(deadline=None)
"""The first call compiles."""

ANY_BATTERY_W = st.floats(-300e3, 300e3)
ACTIONS = st.sampled_from([2, 7, 65, 1600])
KINDS: tuple[RewardKind, ...] = ("fuel", "piecewise", "piecewise_corrected", "equivalent_fuel")
MAPPINGS = pytest.mark.parametrize("mapping", ["p_batt_grid", "p_eng_knots"])


def process(mapping="p_batt_grid", actions=1600, kind: RewardKind = "fuel") -> Mdp:
    reward = RewardConfig(kind=kind, start_price_kg=0.0)
    return make_mdp(
        PAPER,
        np.array([100e3, 150e3]),
        reward,
        mapping=mapping,
        actions=actions,
        soc_initial=0.85,
        soc_target=SOC_TARGET,
    )


def production_bounds_w(demand_w: float, soc: float) -> tuple[float, float]:
    limits = power_limits(PAPER, initial_state(PAPER, soc))
    lb, ub = feasible_battery_power_w(limits, np.array([demand_w]))
    return float(lb[0]), float(ub[0])


def production_step(demand_w: float, soc: float, wanted_w: float):
    command = Command(np.array([wanted_w]), np.array([np.nan]))
    return step(PAPER, initial_state(PAPER, soc), np.array([demand_w]), command)


@COMPILED
@given(DEMAND_W, SOC)
def test_bounds_are_those_of_the_plant(demand_w: float, soc: float):
    assert bounds_w(process(), demand_w, soc) == production_bounds_w(demand_w, soc)


@settings(COMPILED, max_examples=300)
@given(DEMAND_W, SOC, ANY_BATTERY_W)
def test_a_step_is_that_of_the_plant(demand_w: float, soc: float, wanted_w: float):
    mdp = process()
    lb, ub = bounds_w(mdp, demand_w, soc)
    projected_w = min(max(wanted_w, lb), max(lb, ub))
    after, engine_w, fuel_kg = advance(mdp, demand_w, soc, projected_w)
    state, result = production_step(demand_w, soc, wanted_w)
    assert after == pytest.approx(state.soc[0], rel=1e-9, abs=0.0)
    assert engine_w == pytest.approx(result.engine_power_w[0], rel=1e-9, abs=0.0)
    assert fuel_kg == pytest.approx(result.fuel_kg[0], rel=1e-9, abs=0.0)


@COMPILED
@given(DEMAND_W, SOC, ACTIONS)
def test_feasible_battery_actions_are_those_of_the_grid(demand_w: float, soc: float, actions: int):
    mdp = process(actions=actions)
    lb, ub = bounds_w(mdp, demand_w, soc)
    first, last = feasible_range(mdp.action_power_w, np.array([lb]), np.array([ub]))
    assert feasible_actions(mdp, demand_w, lb, ub) == (first[0], last[0])


@MAPPINGS
@COMPILED
@given(DEMAND_W, SOC, ACTIONS)
def test_every_feasible_action_is_within_the_bounds_and_the_ends_are_the_bounds(
    mapping: str, demand_w: float, soc: float, actions: int
):
    mdp = process(mapping, actions)
    lb, ub = bounds_w(mdp, demand_w, soc)
    assume(lb <= ub)
    first, last = feasible_actions(mdp, demand_w, lb, ub)
    powers = np.array([battery_power_w(mdp, a, demand_w, lb, ub) for a in range(first, last + 1)])
    assert np.all((lb <= powers) & (powers <= ub))
    low, high = (powers[0], powers[-1]) if mapping == "p_batt_grid" else (powers[-1], powers[0])
    assert high == pytest.approx(ub, rel=1e-12, abs=1e-9)
    assert low == pytest.approx(lb, rel=1e-12, abs=1e-9)


@MAPPINGS
@COMPILED
@given(DEMAND_W, SOC, ACTIONS)
def test_no_power_within_the_bounds_is_left_out(
    mapping: str, demand_w: float, soc: float, actions: int
):
    mdp = process(mapping, actions)
    lb, ub = bounds_w(mdp, demand_w, soc)
    meant_w = demand_w - mdp.action_power_w if mdp.engine_actions else mdp.action_power_w
    inside = np.flatnonzero((meant_w > lb) & (meant_w < ub))
    first, last = feasible_actions(mdp, demand_w, lb, ub)
    assert np.all((first <= inside) & (inside <= last))


@MAPPINGS
@COMPILED
@given(DEMAND_W, SOC, ACTIONS)
def test_off_is_an_action_whenever_the_battery_can_carry_the_demand(
    mapping: str, demand_w: float, soc: float, actions: int
):
    """Action 0 of the knots, the last feasible one of the grid."""
    mdp = process(mapping, actions)
    lb, ub = bounds_w(mdp, demand_w, soc)
    assume(lb <= ub == demand_w)
    first, last = feasible_actions(mdp, demand_w, lb, ub)
    off = first if mapping == "p_eng_knots" else last
    assert mapping == "p_batt_grid" or off == 0
    wanted_w = battery_power_w(mdp, off, demand_w, lb, ub)
    _, engine_w, fuel_kg = advance(mdp, demand_w, soc, wanted_w)
    assert (engine_w, fuel_kg) == (0.0, 0.0)


@COMPILED
@given(
    st.tuples(st.floats(350e3, 600e3), st.floats(0.70, 0.7001))
    | st.tuples(st.floats(-100e3, -70e3), st.floats(0.8999, 0.90))
)
def test_where_neither_bound_can_be_kept_the_only_choice_is_lb(state: tuple[float, float]):
    """An almost empty battery under a large demand, an almost full one under braking."""
    demand_w, soc = state
    for mapping in ("p_batt_grid", "p_eng_knots"):
        mdp = process(mapping)
        lb, ub = bounds_w(mdp, demand_w, soc)
        assert lb > ub
        first, last = feasible_actions(mdp, demand_w, lb, ub)
        for action in (first, last):
            assert battery_power_w(mdp, action, demand_w, lb, ub) == lb


def test_knots_start_at_off_and_end_at_full_power():
    mdp = process("p_eng_knots", 56)
    np.testing.assert_allclose(mdp.action_power_w, np.arange(56) * 5e3)
    assert mdp.engine_actions


@pytest.mark.parametrize("kind", KINDS)
@settings(COMPILED, max_examples=200)
@given(DEMAND_W, SOC, ANY_BATTERY_W)
def test_a_reward_is_that_of_the_reward_module(
    kind: RewardKind, demand_w: float, soc: float, wanted_w: float
):
    mdp = process(kind=kind)
    reward = RewardConfig(kind=kind, start_price_kg=0.0)
    state, result = production_step(demand_w, soc, wanted_w)
    engine_w, fuel_kg, after = result.engine_power_w, result.fuel_kg, state.soc
    expected = step_reward(
        reward,
        PAPER,
        fuel_kg=fuel_kg,
        engine_power_w=engine_w,
        engine_on=state.engine_on,
        engine_started=result.engine_started,
        soc=np.array([soc]),
        soc_next=after,
        soc_target=np.array([SOC_TARGET]),
    )
    got = reward_of(mdp, float(engine_w[0]), float(fuel_kg[0]), soc, float(after[0]))
    assert got * mdp.cost_unit == pytest.approx(expected[0], rel=1e-9, abs=1e-12)


@pytest.mark.parametrize(
    ("engine_kw", "penalty"),
    [(0, 0.0), (60, 0.1), (110, 0.0), (150, 0.0), (190, 0.0), (250, 0.36), (275, 0.51)],
)
def test_the_corrected_reward_by_hand(engine_kw: float, penalty: float):
    """-[(fuel + price of the battery's energy) / fuel at the best point + penalty]; 3.6 MJ
    taken from 185 kWh at best efficiency 0.437 cost 3.6e6 / (0.437 LHV), at the target SOC."""
    mdp = process(kind="piecewise_corrected")._replace(kp=0.0)
    fuel_kg = 0.003
    lhv = PAPER.engine.fuel_lhv_j_per_kg
    share = (fuel_kg + 3.6e6 / (0.437 * lhv)) / (150e3 / (0.437 * lhv))
    got = reward_of(mdp, engine_kw * 1e3, fuel_kg, 0.85, 0.85 - 1.0 / 185.0)
    assert best_fuel_kg(PAPER) == pytest.approx(150e3 / (0.437 * lhv))
    assert got == pytest.approx(-(share + penalty), rel=1e-9)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("start_fuel_kg", 0.015),
        ("min_on_s", 5.0),
        ("min_off_s", 5.0),
        ("ramp_w_per_s", 60e3),
        ("idle_fuel_kg_per_s", 0.00025),
    ],
)
def test_an_engine_with_memory_or_idling_is_refused(name: str, value: float):
    plant = replace(PAPER, engine=replace(PAPER.engine, **{name: value}))
    with pytest.raises(ConfigError, match=rf"engine\.{name}"):
        make_mdp(
            plant,
            np.array([1e5]),
            RewardConfig(kind="fuel"),
            mapping="p_batt_grid",
            actions=16,
            soc_initial=0.85,
            soc_target=0.85,
        )


def test_a_price_per_start_is_refused():
    with pytest.raises(ConfigError, match=r"reward\.start_price_kg"):
        make_mdp(
            PAPER,
            np.array([1e5]),
            RewardConfig(kind="equivalent_fuel", start_price_kg=0.002),
            mapping="p_batt_grid",
            actions=16,
            soc_initial=0.85,
            soc_target=0.85,
        )


def test_every_reward_kind_has_a_compiled_form():
    assert set(KINDS) == set(mdp_module._REWARDS)
