"""Counterfactual targets against the plant itself, and what the learned policy does with them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tractor_ems.drive import drive
from tractor_ems.learning.all_actions import build_cost_table, enumerate_actions
from tractor_ems.learning.config import CounterfactualConfig
from tractor_ems.learning.counterfactual import (
    CounterfactualLearner,
    Problem,
    backup,
    demand_baseline,
    make_problem,
)
from tractor_ems.learning.networks import Net, to_numpy
from tractor_ems.learning.rewards import RewardConfig, battery_price, resolve, start_cost
from tractor_ems.learning.samples import demand_samples, demand_scaling, observation_spec
from tractor_ems.policies.mlp import forward
from tractor_ems.policies.q_policy import QPolicy, soc_input, split_values
from tractor_msgs_py.errors import ConfigError
from tractor_sim.duty_cycle.library import load_cycle
from tractor_sim.powertrain import (
    Command,
    PlantState,
    PowertrainParams,
    battery_power_grid_w,
    feasible_battery_power_w,
    power_limits,
    step,
)

GAMMA = 0.9


def problem_of(
    paper: PowertrainParams,
    reward: RewardConfig,
    demands: list[np.ndarray],
    config: CounterfactualConfig,
) -> Problem:
    scaling = demand_scaling(demands)
    spec = observation_spec(scaling, 1.0, 120.0, 8.0)
    samples = demand_samples(demands, spec, scaling, 1.0)
    return make_problem(paper, resolve(reward, paper), scaling, config, samples, 1600)


def plain_backup(problem: Problem, online, target, tick: int, soc: float, soc_target: float):
    """Drive all 1600 actions on the plant from both engine states; loops and float64."""
    params, reward = problem.params, problem.reward
    grid = battery_power_grid_w(params)
    demand = np.full(1600, problem.samples.power_demand_w[tick])
    start = start_cost(reward, params) / reward.cost_unit
    answers = []
    for engine_on in (True, False):
        state = PlantState(
            np.full(1600, soc), np.full(1600, engine_on), np.full(1600, 99.0), np.zeros(1600)
        )
        after, result = step(params, state, demand, Command(grid, np.full(1600, np.nan)))
        cost = result.fuel_kg + battery_price(
            reward, params, state.soc, after.soc, np.full(1600, soc_target)
        )
        cost = cost / reward.cost_unit + np.where(result.engine_started, start, 0.0)
        error = soc_input(problem.scaling, after.soc, np.full(1600, soc_target))
        inputs = np.concatenate(
            (np.repeat(problem.samples.inputs[[tick]], 1600, axis=0), error[:, None]), axis=1
        )

        def value(net, inputs=inputs, after=after):
            w_on, w_off = split_values(forward(to_numpy(net), inputs), start)
            return np.where(after.engine_on, w_on, w_off).astype(np.float64)

        chosen = int(np.argmin(cost + GAMMA * value(online)))
        answers.append(cost[chosen] + GAMMA * value(target)[chosen] - problem.baseline[tick])
    return answers


@pytest.mark.parametrize("double", [True, False], ids=["double", "single"])
def test_a_backup_equals_driving_all_actions_on_the_plant(paper: PowertrainParams, double: bool):
    """Also at the SOC limits, with demand nothing can meet, and with braking."""
    demand = load_cycle("planter_20").power_demand_w[:60].copy()
    demand[[5, 6, 7, 8]] = [520e3, 600e3, -80e3, 3e3]
    config = CounterfactualConfig(gamma=GAMMA, double=double)
    problem = problem_of(paper, RewardConfig(), [demand], config)
    rng = np.random.default_rng(1)
    online, target = Net((4, 16, 2), "tanh", rng), Net((4, 16, 2), "tanh", rng)
    with torch.no_grad():
        online.weights[-1].mul_(20.0)  # so that the two nets prefer different actions
        target.weights[-1].mul_(20.0)
    tick = np.array([5, 6, 7, 8, 9, 10, 7, 30, 59, 20, 21])
    soc = np.array([0.8, 0.75, 0.8, 0.8, 0.70, 0.90, 0.90, 0.85, 0.7001, 0.8999, 0.836])
    soc_target = np.array([0.8, 0.836, 0.7, 0.9, 0.8, 0.8, 0.8, 0.836, 0.75, 0.836, 0.836])
    y_on, y_off = backup(problem, online, target, tick, soc, soc_target)
    chooser = online if double else target
    for k in range(len(tick)):
        on, off = plain_backup(problem, chooser, target, tick[k], soc[k], soc_target[k])
        assert y_on[k] == pytest.approx(on, abs=2e-3), (k, "on")
        assert y_off[k] == pytest.approx(off, abs=2e-3), (k, "off")


def test_enumerated_costs_are_the_plants_and_infeasible_ones_infinite(paper: PowertrainParams):
    reward = resolve(RewardConfig(), paper)
    demand = np.array([150e3, 40e3, 262e3])
    soc = np.array([0.8, 0.70003, 0.89999])
    table = build_cost_table(reward, paper, 1600, 10e3, 270e3)
    state = PlantState(soc, np.ones(3, bool), np.full(3, 9.0), np.zeros(3))
    lb, ub = feasible_battery_power_w(power_limits(paper, state), demand)
    found = enumerate_actions(table, reward, paper, demand, lb, ub)
    for row in range(3):
        many = PlantState(
            np.full(1600, soc[row]), np.ones(1600, bool), np.full(1600, 9.0), np.zeros(1600)
        )
        grid = battery_power_grid_w(paper)
        command = Command(grid, np.full(1600, np.nan))
        _, result = step(paper, many, np.full(1600, demand[row]), command)
        finite = np.isfinite(found.running[row])
        burnt = result.fuel_kg[finite] / reward.cost_unit
        assert finite.sum() > 10
        assert np.abs(found.running[row][finite] - burnt).max() < 2e-4
        inner = (grid > lb[row]) & (grid < ub[row])
        assert np.all(finite[inner]), "a feasible action is missing"


def test_the_baseline_depends_on_demand_alone_and_changes_no_choice(paper: PowertrainParams):
    """On the lossless plant the best engine-on Hamiltonian is lambda0 P_dem."""
    reward = resolve(RewardConfig(), paper)
    assert reward.lambda0_kg_per_j is not None
    demand = np.linspace(20e3, 260e3, 97)
    table = build_cost_table(reward, paper, 1600, 20e3, 260e3)
    baseline = demand_baseline(table, reward, paper, demand)
    expected = reward.lambda0_kg_per_j * demand / reward.cost_unit
    assert np.abs(baseline - expected).max() < 1e-3


def test_a_battery_with_losses_is_refused_in_one_line(paper: PowertrainParams):
    lossy = replace(paper, battery=replace(paper.battery, resistance_ohm=0.08))
    demand = np.full(10, 100e3)
    with pytest.raises(ConfigError, match="battery with losses"):
        problem_of(lossy, RewardConfig(), [demand], CounterfactualConfig())


def test_a_ramp_limit_is_refused_in_one_line(paper: PowertrainParams):
    ramped = replace(paper, engine=replace(paper.engine, ramp_w_per_s=60e3))
    demand = load_cycle("planter_20").power_demand_w[:60]
    with pytest.raises(ConfigError, match="ramp limit"):
        problem_of(ramped, RewardConfig(), [demand], CounterfactualConfig())


def learn(
    paper: PowertrainParams, config: CounterfactualConfig, reward: RewardConfig | None = None
) -> QPolicy:
    demands = [load_cycle(f"planter_{seed}").power_demand_w for seed in (21, 22, 23)]
    problem = problem_of(paper, reward or RewardConfig(), demands, config)
    learner = CounterfactualLearner(
        problem, config, np.random.default_rng(0), np.random.default_rng(1)
    )
    for _ in range(config.updates):
        learner.update()
    spec = observation_spec(problem.scaling, 1.0, 120.0, 8.0)
    return QPolicy(
        "ddqn_counterfactual",
        spec,
        paper,
        problem.reward,
        learner.network(),
        problem.scaling,
        config.gamma,
    )


@pytest.fixture(scope="module")
def far_sighted(paper: PowertrainParams) -> QPolicy:
    """500 updates from the demand of three cycles."""
    return learn(paper, CounterfactualConfig(updates=500))


def test_a_short_training_sustains_charge_at_the_engines_best_point(
    paper: PowertrainParams, far_sighted: QPolicy
):
    """Driven on cycles it has not seen, to three targets."""
    demand = np.stack([load_cycle(f"planter_{seed}").power_demand_w for seed in (81, 82, 83)])
    runs = drive(
        far_sighted, paper, demand, np.array([0.85, 0.80, 0.88]), np.array([0.836, 0.8, 0.84])
    )
    for run, target in zip(runs, (0.836, 0.80, 0.84), strict=True):
        assert abs(run.soc_final - target) < 0.02
        efficiency = run.engine_power_w.sum() / (run.fuel_kg.sum() * 42.8e6)
        assert efficiency > 0.99 * 0.437
        assert run.shortfall_j.sum() == 0.0


def test_learning_pays_for_a_start_that_greed_never_makes(
    paper: PowertrainParams, far_sighted: QPolicy
):
    """The myopic trap: a start pays back over many steps, never within one, so the same costs
    without a future run the battery down."""
    greedy = replace(far_sighted, gamma=0.0)
    demand = load_cycle("planter_84").power_demand_w[None, :]
    (wise,), (trapped,) = (drive(p, paper, demand, 0.836, 0.836) for p in (far_sighted, greedy))
    assert wise.soc_final > 0.82
    assert trapped.soc_final < 0.80


@pytest.mark.parametrize("kind", ["fuel", "piecewise"])
def test_rewards_that_do_not_price_the_battery_run_it_down(paper: PowertrainParams, kind: str):
    """The printed shaped reward too: engine off earns more than any engine point."""
    policy = learn(paper, CounterfactualConfig(updates=100), RewardConfig(kind=kind))  # type: ignore[arg-type]
    demand = load_cycle("planter_85").power_demand_w[None, :400]
    run = drive(policy, paper, demand, 0.75, 0.75)[0]
    assert run.soc_final < 0.702
    assert run.shortfall_j.sum() == 0.0
