"""The baselines on a short piece of the study's cycle: complete, ordered, and counted alike."""

import dataclasses

import numpy as np
import pytest

from tractor_ems.drive import drive
from tractor_ems.learning.mdp import (
    advance,
    battery_power_w,
    bounds_w,
    feasible_actions,
    make_mdp,
)
from tractor_ems.learning.mdp import reward_of as compiled_reward
from tractor_ems.learning.rewards import RewardKind
from tractor_ems.policies.rules import BestPoint, Conventional, RuleBased
from tractor_ems.study.baselines import (
    REWARDS,
    SOC_MINS,
    Myopic,
    RandomFeasible,
    make_baselines,
    outcome_of,
    reward_config,
)
from tractor_ems.study.results import Baseline
from tractor_msgs_py.trajectory import trajectory_hash
from tractor_sim.config import load_powertrain
from tractor_sim.duty_cycle.library import load_cycle
from tractor_sim.powertrain import PowertrainParams

PAPER = load_powertrain("paper")
PLANTER_W = load_cycle("planter").power_demand_w
SHORT_W = PLANTER_W[40:160]
FOLLOWS_THE_LOAD = RuleBased(PAPER, threshold_w=0.0, soc_guard=False)
"""An engine that carries every load alone and is off where there is none."""

IDS = (
    "conventional",
    "dp",
    "rule_based",
    "best_point",
    "random_feasible",
    "myopic",
    "optimum",
)


def plants() -> dict[float, PowertrainParams]:
    battery = PAPER.battery
    return {
        soc_min: dataclasses.replace(PAPER, battery=dataclasses.replace(battery, soc_min=soc_min))
        for soc_min in SOC_MINS
    }


Key = tuple[str, str, float]


def by_key(baselines: tuple[Baseline, ...]) -> dict[Key, Baseline]:
    return {(item.id, item.reward, item.soc_min): item for item in baselines}


@pytest.fixture(scope="module")
def short() -> dict[Key, Baseline]:
    """SOC 0.842 leaves little to drain, so that SOC_min 0.836 binds within the piece."""
    rng = np.random.default_rng(0)
    return by_key(make_baselines(plants(), SHORT_W, rng, soc_initial=0.842))


def test_every_baseline_is_there_for_every_reward_and_soc_min(short: dict[Key, Baseline]):
    assert list(short) == [(i, r, m) for m in SOC_MINS for r in REWARDS for i in IDS]


def test_no_baseline_earns_more_than_the_optimum(short: dict[Key, Baseline]):
    for (name, reward, soc_min), item in short.items():
        best = short["optimum", reward, soc_min].outcome.reward_sum
        assert item.outcome.reward_sum <= best + 1e-5 * abs(best), (name, reward, soc_min)


def test_no_baseline_beats_dp_at_its_own_final_soc(short: dict[Key, Baseline]):
    for key, item in short.items():
        outcome = item.outcome
        assert outcome.dp_ratio is not None or outcome.dp_note, key
        assert (outcome.dp_ratio or 0.0) <= 1.0005, key
    assert short["dp", "fuel", 0.70].outcome.dp_ratio == pytest.approx(1.0, abs=1e-3)


def test_dp_ends_at_the_target_on_both_plants(short: dict[Key, Baseline]):
    for soc_min in SOC_MINS:
        outcome = short["dp", "fuel", soc_min].outcome
        assert outcome.soc_final == pytest.approx(0.836, abs=1e-6)


def test_best_point_still_works_where_the_target_is_soc_min(short: dict[Key, Baseline]):
    outcome = short["best_point", "fuel", 0.836].outcome
    assert outcome.shortfall_j == 0.0
    assert outcome.soc_final >= 0.836
    assert outcome.efficiency == pytest.approx(0.437, abs=2e-3)


def test_greedy_on_the_printed_reward_or_on_fuel_drains_the_battery(short: dict[Key, Baseline]):
    for reward in ("fuel", "piecewise"):
        assert short["myopic", reward, 0.836].outcome.soc_final < 0.8365


def test_one_drive_is_counted_in_every_reward(short: dict[Key, Baseline]):
    drives = [short["conventional", reward, 0.70].outcome for reward in REWARDS]
    assert len({trajectory_hash(outcome.trajectory) for outcome in drives}) == 1
    assert len({outcome.reward_sum for outcome in drives}) == len(REWARDS)
    fuel = short["conventional", "fuel", 0.70].outcome
    assert fuel.reward_sum == pytest.approx(-fuel.fuel_kg / 0.010, rel=1e-12)


def test_the_same_generator_gives_the_same_random_drive():
    hashes = [
        trajectory_hash(item.outcome.trajectory)
        for seed in (0, 0, 1)
        for item in make_baselines(
            {0.70: PAPER}, SHORT_W[:30], np.random.default_rng(seed), rewards=("fuel",)
        )
        if item.id == "random_feasible"
    ]
    assert hashes[0] == hashes[1] != hashes[2]


def test_random_driving_reaches_both_ends_of_the_feasible_range():
    """A draw at either end is lb, all the engine gives, and ub, engine off."""
    demand_w = np.full((1, 4), 120e3)
    draws = np.array([0.0, 1.0 - 1e-12, 0.0, 1.0 - 1e-12])
    run = drive(RandomFeasible(PAPER, draws), PAPER, demand_w, 0.80, 0.836)[0]
    assert run.engine_power_w == pytest.approx([275e3, 0.0, 275e3, 0.0])
    assert run.engine_on.tolist() == [True, False, True, False]


@pytest.mark.parametrize("kind", REWARDS)
@pytest.mark.parametrize("soc_initial", [0.836, 0.85])
def test_myopic_takes_the_best_action_of_the_learners_own_environment(
    kind: RewardKind, soc_initial: float
):
    params, reward = plants()[0.836], reward_config(kind)
    mdp = make_mdp(
        params,
        SHORT_W,
        reward,
        mapping="p_batt_grid",
        actions=1600,
        soc_initial=soc_initial,
        soc_target=0.836,
    )
    run = drive(Myopic(params, reward), params, SHORT_W[None, :20], soc_initial, 0.836)[0]
    for k in range(20):
        demand_w, soc = float(SHORT_W[k]), float(run.soc[k])
        lb, ub = bounds_w(mdp, demand_w, soc)
        first, last = feasible_actions(mdp, demand_w, lb, ub)
        earned = []
        for action in range(first, last + 1):
            wanted_w = battery_power_w(mdp, action, demand_w, lb, ub)
            after, engine_w, fuel_kg = advance(mdp, demand_w, soc, wanted_w)
            earned.append(compiled_reward(mdp, engine_w, fuel_kg, soc, after))
        after, engine_w, fuel_kg = advance(mdp, demand_w, soc, float(run.battery_power_w[k]))
        chosen = compiled_reward(mdp, engine_w, fuel_kg, soc, after)
        assert chosen == pytest.approx(max(earned), abs=1e-6)


def test_an_outcome_tells_how_the_engine_ran():
    demand_w = np.array([[50e3, 50e3, 0.0, 100e3, 150e3]])
    run = drive(FOLLOWS_THE_LOAD, PAPER, demand_w, 0.85, 0.836)[0]
    outcome = outcome_of(run, PAPER, reward_config("piecewise"))
    assert outcome.engine_on_s == 4.0
    assert outcome.below_60kw_share == 0.5
    assert outcome.engine_starts == 2
    assert (outcome.soc_initial, outcome.soc_final) == (0.85, 0.85)
    at_50, at_100 = 0.18 + 0.07 * 2 / 3, 0.395
    expected = 2 * (-0.58 - 0.12 - at_50) + 2.46 + (-0.58 - 0.02 - at_100) + 1.437
    assert outcome.reward_sum == pytest.approx(expected, rel=1e-9)


def test_a_drive_without_the_engine_has_no_efficiency_and_no_share():
    run = drive(FOLLOWS_THE_LOAD, PAPER, np.zeros((1, 3)), 0.85, 0.836)[0]
    outcome = outcome_of(run, PAPER, reward_config("fuel"))
    assert outcome.efficiency is None
    assert outcome.below_60kw_share is None
    assert outcome.engine_on_s == 0.0


def test_undelivered_demand_is_a_note_and_no_score():
    run = drive(Conventional(), PAPER, np.full((1, 3), 900e3), 0.85, 0.836)[0]
    outcome = outcome_of(run, PAPER, reward_config("fuel"))
    assert outcome.dp_ratio is None
    assert outcome.dp_note is not None
    assert "unmet" in outcome.dp_note


def test_a_ratio_that_is_known_is_not_computed_again():
    run = drive(BestPoint(PAPER), PAPER, SHORT_W[None, :5], 0.85, 0.836)[0]
    outcome = outcome_of(run, PAPER, reward_config("fuel"), ratio=(0.5, "known"))
    assert (outcome.dp_ratio, outcome.dp_note) == (0.5, "known")


@pytest.mark.slow
def test_the_studys_baselines_on_the_whole_cycle():
    made = by_key(make_baselines(plants(), PLANTER_W, np.random.default_rng(0)))
    for (_, reward, soc_min), item in made.items():
        outcome, best = item.outcome, made["optimum", reward, soc_min].outcome.reward_sum
        assert outcome.shortfall_j == 0.0
        assert outcome.dp_ratio is not None
        assert outcome.dp_ratio <= 1.0005
        assert outcome.reward_sum <= best + 1e-6 * abs(best)
