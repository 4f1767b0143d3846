"""What each reward asks for: its exact optimum, beside enumeration, rules and random driving."""

import dataclasses
import itertools
from functools import cache

import numpy as np
import pytest
from _pytest.mark.structures import ParameterSet
from hypothesis import given, settings
from hypothesis import strategies as st

from tractor_ems.drive import drive
from tractor_ems.learning.rewards import RewardConfig, RewardKind, running_cost
from tractor_ems.optimal.dp import solve
from tractor_ems.optimal.reward_dp import roll_out_reward, solve_reward
from tractor_ems.optimal.rollout import roll_out
from tractor_ems.policies.protocol import Policy
from tractor_ems.policies.rules import BestPoint, Conventional, RuleBased
from tractor_ems.study.baselines import Myopic, RandomFeasible, reward_sum
from tractor_msgs_py.errors import ConfigError, PolicyError
from tractor_msgs_py.trajectory import FloatArray, Trajectory
from tractor_sim.config import load_powertrain
from tractor_sim.duty_cycle.library import load_cycle
from tractor_sim.figures import run_figures
from tractor_sim.powertrain import Command, PowertrainParams, initial_state, step

PAPER = load_powertrain("paper")
PLANTER_W = load_cycle("planter").power_demand_w
KINDS: tuple[RewardKind, ...] = ("fuel", "piecewise", "piecewise_corrected", "equivalent_fuel")


def plant(soc_min: float) -> PowertrainParams:
    return dataclasses.replace(PAPER, battery=dataclasses.replace(PAPER.battery, soc_min=soc_min))


def reward_of(kind: RewardKind) -> RewardConfig:
    return RewardConfig(kind=kind, start_price_kg=0.0)


def priced_at_both(kinds: tuple[RewardKind, ...]) -> list[ParameterSet]:
    """Each kind at both SOC_min. The optima of the whole window take longest, and what prices
    the battery does not come near its lower end: those two are slow."""
    return [
        pytest.param(
            kind,
            soc_min,
            marks=[pytest.mark.slow] * (soc_min == 0.70 and kind not in ("fuel", "piecewise")),
        )
        for kind in kinds
        for soc_min in (0.70, 0.836)
    ]


@cache
def optimum(kind: RewardKind, soc_min: float) -> tuple[float, Trajectory]:
    """Value and roll-out on the paper's cycle."""
    params = plant(soc_min)
    points = 801 if soc_min < 0.8 else 257
    solution = solve_reward(
        params, PLANTER_W, reward_of(kind), soc_initial=0.85, soc_target=0.836, soc_points=points
    )
    return solution.best_return, roll_out_reward(solution, params)


@pytest.mark.parametrize(("kind", "soc_min"), priced_at_both(KINDS))
def test_the_real_plant_earns_what_the_optimum_promises(kind: RewardKind, soc_min: float):
    value, run = optimum(kind, soc_min)
    earned = reward_sum(run, plant(soc_min), reward_of(kind), 0.836)
    assert earned == pytest.approx(value, rel=5e-4)
    assert run.shortfall_j.sum() == 0.0


@pytest.mark.parametrize(
    ("soc_min", "fuel_gal", "efficiency", "soc_final"),
    [(0.70, 0.17, 0.425, 0.70), (0.836, 1.74, 0.425, 0.836)],
)
def test_the_printed_reward_drains_the_battery_to_soc_min(
    soc_min: float, fuel_gal: float, efficiency: float, soc_final: float
):
    """No single SOC_min gives both of the paper's rows, 0.30 gal at 70 % and 1.75 at 83.6 %."""
    figures = run_figures(optimum("piecewise", soc_min)[1], plant(soc_min))
    assert figures["fuel_gal"] == pytest.approx(fuel_gal, rel=0.02)
    assert figures["efficiency"] == pytest.approx(efficiency, rel=0.005)
    assert figures["soc_final"] == pytest.approx(soc_final, abs=3e-4)


def test_the_printed_reward_runs_the_engine_at_190_kw_to_earn_more_seconds_off():
    run = optimum("piecewise", 0.836)[1]
    assert np.median(run.engine_power_w[run.engine_on]) == pytest.approx(190e3, abs=0.01)


@pytest.mark.parametrize("soc_min", [0.70, 0.836])
def test_fuel_alone_drains_the_battery_too_but_at_the_best_point(soc_min: float):
    figures = run_figures(optimum("fuel", soc_min)[1], plant(soc_min))
    assert figures["soc_final"] == pytest.approx(soc_min, abs=3e-4)
    assert figures["efficiency"] == pytest.approx(0.437, rel=5e-3)


@pytest.mark.parametrize(
    ("kind", "soc_min"), priced_at_both(("piecewise_corrected", "equivalent_fuel"))
)
def test_a_reward_that_prices_the_battery_holds_soc_and_keeps_the_fuel_optimum(
    kind: RewardKind, soc_min: float
):
    run = optimum(kind, soc_min)[1]
    assert run.soc_final == pytest.approx(0.836, abs=1e-3)
    best = roll_out(solve(PAPER, PLANTER_W, run.soc_final, soc_initial=0.85), PAPER)
    assert run.fuel_kg.sum() == pytest.approx(best.fuel_kg.sum(), rel=5e-3)


def test_at_a_binding_soc_min_the_printed_reward_costs_fuel_against_dp():
    run = optimum("piecewise", 0.836)[1]
    best = roll_out(solve(PAPER, PLANTER_W, run.soc_final, soc_initial=0.85), PAPER)
    assert run.fuel_kg.sum() > 1.02 * best.fuel_kg.sum()


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_no_rule_and_no_random_driving_earns_more_on_the_papers_cycle(kind: RewardKind):
    params, reward = plant(0.70), reward_of(kind)
    best = reward_sum(optimum(kind, 0.70)[1], params, reward, 0.836)
    draws = np.random.default_rng(3).random(len(PLANTER_W))
    policies: tuple[Policy, ...] = (
        Conventional(),
        BestPoint(params),
        RuleBased(params),
        Myopic(params, reward),
        RandomFeasible(params, draws),
    )
    for policy in policies:
        run = drive(policy, params, PLANTER_W[None, :], 0.85, 0.836)[0]
        assert reward_sum(run, params, reward, 0.836) <= best + 1e-6 * abs(best), policy.name


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    kind=st.sampled_from(KINDS),
    above_min=st.sampled_from([0.0, 1e-4, 0.002, 0.02]),
)
def test_nothing_earns_more_on_short_cycles_near_soc_min(
    seed: int, kind: RewardKind, above_min: float
):
    rng = np.random.default_rng(seed)
    params, reward = plant(0.836), reward_of(kind)
    demand_w = rng.uniform(5e3, 270e3, 40)
    start = 0.836 + above_min
    solution = solve_reward(
        params, demand_w, reward, soc_initial=start, soc_target=0.836, soc_points=401
    )
    best = reward_sum(roll_out_reward(solution, params), params, reward, 0.836)
    policies: tuple[Policy, ...] = (
        Conventional(),
        BestPoint(params),
        RuleBased(params, soc_guard=False),
        Myopic(params, reward),
        RandomFeasible(params, rng.random(40)),
        RandomFeasible(params, rng.integers(0, 2, 40) * 0.999_999),
    )
    for policy in policies:
        run = drive(policy, params, demand_w[None, :], start, 0.836)[0]
        assert reward_sum(run, params, reward, 0.836) <= best + 1e-3 * abs(best), policy.name


def sequences_driven(
    params: PowertrainParams, demand_w: FloatArray, reward: RewardConfig, soc: float
) -> float:
    """Most that any of all sequences of engine powers in 12 steps, edges included, earns."""
    engine_w = np.array([0.0, 20e3, 60e3, 90e3, 110e3 + 1e-3, 130e3, 150e3, 170e3, 190e3 - 1e-3])
    engine_w = np.concatenate([engine_w, [200e3, 230e3, 275e3]])
    plans_w = np.array(list(itertools.product(engine_w, repeat=len(demand_w))))
    total = np.zeros(len(plans_w))
    state = initial_state(params, soc, len(plans_w))
    for k, power_w in enumerate(demand_w):
        demand = np.full(len(plans_w), power_w)
        off = np.where(plans_w[:, k] == 0.0, 0.0, np.nan)
        state, result = step(params, state, demand, Command(power_w - plans_w[:, k], off))
        total -= running_cost(reward, params, result.engine_power_w)
    return float(total.max()) / reward.cost_unit


@pytest.mark.parametrize("kind", ["fuel", "piecewise"])
@pytest.mark.parametrize("charge_j", [0.0, 60e3, 200e3, 1e9])
def test_no_sequence_of_a_full_enumeration_earns_more(kind: RewardKind, charge_j: float):
    params, reward = plant(0.836), reward_of(kind)
    demand_w = np.array([150e3, 45e3, 220e3, 120e3])
    start = min(0.836 + charge_j / params.battery.energy_j, 0.85)
    solution = solve_reward(params, demand_w, reward, soc_initial=start, soc_target=0.836)
    earned = reward_sum(roll_out_reward(solution, params), params, reward, 0.836)
    most = sequences_driven(params, demand_w, reward, start)
    assert earned >= most - 1e-6 * abs(most)


def test_a_price_per_start_is_refused_because_dp_has_no_engine_state():
    with pytest.raises(ConfigError, match=r"reward\.start_price_kg: 0\.002, .* allows 0"):
        solve_reward(PAPER, PLANTER_W[:5], RewardConfig(), soc_initial=0.85, soc_target=0.836)


def test_a_soc_outside_the_window_is_refused():
    with pytest.raises(ConfigError, match=r"soc_initial: 0\.75, allowed 0\.836"):
        solve_reward(
            plant(0.836), PLANTER_W[:5], reward_of("fuel"), soc_initial=0.75, soc_target=0.836
        )


def test_a_solution_does_not_drive_another_powertrain():
    solution = solve_reward(
        PAPER, PLANTER_W[:5], reward_of("fuel"), soc_initial=0.85, soc_target=0.836, soc_points=9
    )
    with pytest.raises(PolicyError, match="cannot drive"):
        roll_out_reward(solution, plant(0.80))
