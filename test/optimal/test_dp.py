"""The optimum against enumeration on the plant, closed-form optima and the paper's rows."""

import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tractor_ems.drive import drive
from tractor_ems.optimal.dp import (
    DpSolution,
    co_state_kg_per_j,
    cost_to_go_kg,
    engine_fuel_kg,
    reachable_soc,
    solve,
)
from tractor_ems.optimal.rollout import roll_out
from tractor_ems.policies.rules import Conventional
from tractor_msgs_py.errors import ConfigError, CycleError
from tractor_sim.config import load_powertrain
from tractor_sim.duty_cycle.library import load_cycle
from tractor_sim.fuel import gallons
from tractor_sim.generator import GeneratorParams
from tractor_sim.powertrain import Command, PowertrainParams, initial_state, step

PAPER = load_powertrain("paper")
PLANTER_W = load_cycle("planter").power_demand_w
BEST_KG_PER_J = 1.0 / (0.437 * PAPER.engine.fuel_lhv_j_per_kg)
QUANTUM_W = 50e3


def quantised_plant() -> PowertrainParams:
    """Every limit, knot and node is a whole number of 50 kJ steps, so that eleven actions are all
    there is to choose from and every move ends on a node."""
    return dataclasses.replace(
        PAPER,
        engine=dataclasses.replace(
            PAPER.engine,
            power_max_w=300e3,
            curve_power_w=(0.0, 50e3, 150e3, 300e3),
            curve_efficiency=(0.1, 0.3, 0.42, 0.38),
        ),
        battery=dataclasses.replace(
            PAPER.battery, energy_j=16 * QUANTUM_W, soc_min=0.25, soc_max=0.75
        ),
        soc_initial=0.5,
    )


def least_cost_by_enumeration(params: PowertrainParams, solution: DpSolution) -> np.ndarray:
    """Of every start node, over all command sequences, each driven on the plant itself."""
    actions_w = np.linspace(-250e3, 250e3, 11)
    sequences = np.array(list(itertools.product(actions_w, repeat=3)))
    silent = np.full(len(sequences), np.nan)
    least = []
    for soc in solution.soc_grid[0]:
        state, cost = initial_state(params, soc, len(sequences)), np.zeros(len(sequences))
        for k, power_w in enumerate(solution.power_demand_w):
            command = Command(sequences[:, k], silent)
            state, result = step(params, state, np.full(len(sequences), power_w), command)
            cost += result.fuel_kg + solution.shortfall_price_kg_per_j * result.shortfall_j
        missing_j = np.maximum(solution.soc_target - state.soc, 0.0) * params.battery.energy_j
        least.append((cost + solution.terminal_price_kg_per_j * missing_j).min())
    return np.array(least)


@settings(max_examples=40, deadline=None)
@given(quanta=st.lists(st.integers(-7, 13), min_size=3, max_size=3), target_node=st.integers(0, 8))
def test_dp_equals_enumeration_on_a_three_step_cycle(quanta, target_node):
    """Drawn are also unmet demand, overflowing braking energy and targets out of reach."""
    params = quantised_plant()
    demand_w = QUANTUM_W * np.array(quanta, dtype=float)
    solution = solve(params, demand_w, 0.25 + target_node / 16, soc_points=9, actions=11)
    expected = least_cost_by_enumeration(params, solution)
    np.testing.assert_allclose(solution.values[0], expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(
    "soc_final",
    [0.836, *(pytest.param(soc, marks=pytest.mark.slow) for soc in (0.82, 0.85, 0.855))],
)
def test_below_the_best_point_the_optimum_mixes_off_and_best_power(soc_final):
    """Fuel is then the engine's energy at best efficiency: no run can be below, DP is on it."""
    energy_j = PLANTER_W.sum() * PAPER.dt_s - (0.85 - soc_final) * PAPER.battery.energy_j
    assert 0 < energy_j / len(PLANTER_W) < 150e3
    run = roll_out(solve(PAPER, PLANTER_W, soc_final, soc_initial=0.85), PAPER)
    bound_kg = energy_j * BEST_KG_PER_J
    assert bound_kg * (1 - 1e-9) <= run.fuel_kg.sum() <= bound_kg * (1 + 2e-4)


def test_above_the_best_point_the_optimum_is_constant_engine_power():
    """Specific fuel rises with power there, so the sum is least where power does not vary."""
    demand_w = np.where(np.arange(120) % 20 < 10, 250e3, 150e3)
    run = roll_out(solve(PAPER, demand_w, 0.8, soc_initial=0.8), PAPER)
    constant_kg = float(engine_fuel_kg(PAPER, np.array(200e3))) * len(demand_w)
    assert constant_kg * (1 - 1e-9) <= run.fuel_kg.sum() <= constant_kg * (1 + 1e-4)


def test_paper_row_of_dp_calibrated_not_reproduced():
    run = roll_out(solve(PAPER, PLANTER_W, 0.836, soc_initial=0.85), PAPER)
    fuel_kg = run.fuel_kg.sum()
    efficiency = run.engine_power_w.sum() / (fuel_kg * PAPER.engine.fuel_lhv_j_per_kg)
    assert gallons(fuel_kg) == pytest.approx(1.70, rel=0.01)
    assert efficiency == pytest.approx(0.4367, rel=0.01)
    assert run.soc_final == pytest.approx(0.836, abs=1e-6)


def test_paper_row_of_conventional_calibrated_not_reproduced():
    run = drive(Conventional(), PAPER, PLANTER_W[None, :], 0.85, 0.85)[0]
    fuel_kg = run.fuel_kg.sum()
    efficiency = run.engine_power_w.sum() / (fuel_kg * PAPER.engine.fuel_lhv_j_per_kg)
    assert gallons(fuel_kg) == pytest.approx(1.95, rel=0.02)
    assert efficiency == pytest.approx(0.41, rel=0.02)


@pytest.mark.parametrize("soc_initial", [None, 0.7, 0.85, 0.9])
def test_shortfall_and_unreachable_targets_have_finite_values(soc_initial):
    demand_w = np.array([50e3, 600e3, -400e3, 530e3, 20e3])
    solution = solve(PAPER, demand_w, 0.9, soc_initial=soc_initial)
    assert np.all(np.isfinite(solution.values))
    assert np.all(solution.values >= 0.0)


def test_unmet_demand_costs_more_than_a_missed_target():
    """50 kW short at SOC_min unless charged before; charging is out of reach of the target."""
    demand_w = np.array([100e3] * 5 + [400e3] * 5)
    params = dataclasses.replace(
        PAPER, battery=dataclasses.replace(PAPER.battery, energy_j=10e6, soc_min=0.2, soc_max=0.9)
    )
    run = roll_out(solve(params, demand_w, 0.9, soc_initial=0.2), params)
    assert run.shortfall_j.sum() == 0.0
    assert run.soc_final < 0.9


def test_full_window_and_reachable_window_agree():
    everywhere = solve(PAPER, PLANTER_W, 0.836, soc_points=1601, actions=101)
    tube = solve(PAPER, PLANTER_W, 0.836, soc_initial=0.85, actions=101)
    assert cost_to_go_kg(tube, 0, 0.85) == pytest.approx(
        float(cost_to_go_kg(everywhere, 0, 0.85)), rel=3e-4
    )


@pytest.mark.parametrize("soc_target", [0.7, 0.7123, 0.836, 0.9])
@pytest.mark.parametrize("soc_initial", [None, 0.8])
def test_target_is_a_node_and_rows_increase(soc_target, soc_initial):
    solution = solve(
        PAPER, PLANTER_W[:300] * 0.9, soc_target, soc_initial=soc_initial, soc_points=51, actions=5
    )
    end = reachable_soc(PAPER, PLANTER_W[:300] * 0.9, 0.8, soc_target)[1][-1]
    assert (soc_target if soc_initial is None else end) in solution.soc_grid[-1]
    assert np.all(np.diff(solution.soc_grid, axis=1) > 0)
    assert np.all(np.diff(solution.values, axis=1) <= 1e-9)  # more SOC never costs more


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), soc=st.sampled_from([0.7, 0.71, 0.8, 0.89, 0.9]))
def test_no_run_leaves_the_range_it_was_said_to_stay_in(seed, soc):
    rng = np.random.default_rng(seed)
    demand_w = rng.uniform(-300e3, 280e3, 40)
    state, path = initial_state(PAPER, soc), [soc]
    for power_w in demand_w:
        command = Command(rng.uniform(-3e5, 3e5, 1), np.full(1, np.nan))
        state, _ = step(PAPER, state, np.array([power_w]), command)
        path.append(float(state.soc[0]))
    low, high = reachable_soc(PAPER, demand_w, soc, path[-1])
    assert np.all(low <= np.array(path) + 1e-12)
    assert np.all(high >= np.array(path) - 1e-12)


def test_a_joule_is_worth_the_best_specific_fuel_while_the_engine_cycles():
    solution = solve(PAPER, PLANTER_W, 0.836, soc_initial=0.85)
    for k in (0, 200, 500):
        price = co_state_kg_per_j(PAPER, solution, k, 0.845)
        assert price == pytest.approx(BEST_KG_PER_J, rel=0.01)


def test_generator_losses_and_idle_fuel_are_in_the_optimum():
    params = dataclasses.replace(
        PAPER,
        engine=dataclasses.replace(PAPER.engine, idle_fuel_kg_per_s=2.5e-4),
        generator=GeneratorParams((0.0, 0.2, 1.0), (0.8, 0.93, 0.93)),
    )
    run = roll_out(solve(params, PLANTER_W[:200], 0.85, soc_initial=0.85), params)
    lossless_kg = PLANTER_W[:200].sum() * BEST_KG_PER_J
    assert run.soc_final == pytest.approx(0.85, abs=1e-6)
    assert run.fuel_kg.sum() == pytest.approx(lossless_kg / 0.93, rel=2e-3)


@pytest.mark.parametrize(
    ("field", "value"),
    [("start_fuel_kg", 0.015), ("min_on_s", 5.0), ("min_off_s", 5.0), ("ramp_w_per_s", 60e3)],
)
def test_engine_memory_is_refused_in_one_line(field, value):
    params = dataclasses.replace(PAPER, engine=dataclasses.replace(PAPER.engine, **{field: value}))
    with pytest.raises(ConfigError, match=f"engine.{field} is {value}") as error:
        solve(params, PLANTER_W, 0.85)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"soc_target": 0.95}, "soc_target: 0.95, allowed 0.7..0.9"),
        ({"soc_target": float("nan")}, "soc_target: nan"),
        ({"soc_initial": 0.1}, "soc_initial: 0.1, allowed 0.7..0.9"),
        ({"soc_points": 3}, "soc_points: 3, allowed >= 4"),
        ({"actions": 1}, "actions: 1, allowed >= 2"),
    ],
)
def test_out_of_range_input_is_named(arguments, message):
    with pytest.raises(ConfigError, match=message):
        solve(PAPER, PLANTER_W, **{"soc_target": 0.85, **arguments})


@pytest.mark.parametrize("demand_w", [np.array([]), np.array([1e3, np.nan]), np.ones((2, 2))])
def test_a_cycle_that_is_not_a_finite_column_is_refused(demand_w):
    with pytest.raises(CycleError, match="power_demand_w"):
        solve(PAPER, demand_w, 0.85)


def test_roll_out_needs_a_start():
    with pytest.raises(ConfigError, match="soc_initial"):
        roll_out(solve(PAPER, PLANTER_W[:5], 0.85, soc_points=5, actions=5), PAPER)
