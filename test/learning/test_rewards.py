"""The rewards: the paper's as printed, and a price of battery energy that telescopes."""

from dataclasses import replace

import numpy as np
import pytest

from tractor_ems.learning.rewards import (
    RewardConfig,
    battery_price,
    best_specific_fuel_kg_per_j,
    piecewise_reward,
    resolve,
    running_cost,
    start_cost,
    step_reward,
)
from tractor_msgs_py.errors import ConfigError
from tractor_sim.powertrain import PowertrainParams

EQUIVALENT = RewardConfig()


@pytest.mark.parametrize(
    ("power_w", "reward"),
    [
        (0.0, 2.46),
        (1.0, -0.58 - 0.22 + 2e-6 - (0.05 + 0.05 / 10e3)),
        (10e3, -0.58 - 0.20 - 0.10),
        (60e3, -0.58 - 0.10 - 0.25),
        (90e3, -0.58 - 0.04 - 0.37),
        (110e3 - 1e-6, -0.58 - 0.42),
        (110e3, 1.42),
        (130e3, 1.4285),
        (150e3, 1.437),
        (190e3, 1.425),
        (190e3 + 1e-6, -0.06 - 0.425),
        (230e3, -0.06 - 0.24 - 0.41),
        (275e3 - 1e-6, -0.06 - 0.51 - 0.39),
        (275e3, -2.0),
        (300e3, -2.0),
        (-1.0, -2.0),
    ],
)
def test_piecewise_reward_is_the_papers_as_printed(
    paper: PowertrainParams, power_w: float, reward: float
):
    assert piecewise_reward(paper.engine, np.array([power_w]))[0] == pytest.approx(
        reward, abs=1e-9
    )


def test_piecewise_reward_prefers_engine_off_to_every_engine_point(paper: PowertrainParams):
    on = piecewise_reward(paper.engine, np.linspace(1.0, 275e3, 20_001))
    assert on.max() == pytest.approx(1.437, abs=1e-6)
    assert piecewise_reward(paper.engine, np.zeros(1))[0] > on.max() + 1.0


def test_piecewise_reward_falls_with_efficiency_below_110_kw_and_jumps_by_2_4_there(
    paper: PowertrainParams,
):
    slope = np.diff(piecewise_reward(paper.engine, np.array([60e3, 90e3])))
    assert slope[0] < 0.0
    edge = piecewise_reward(paper.engine, np.array([110e3 - 1e-3, 110e3]))
    assert edge[1] - edge[0] == pytest.approx(2.42, abs=1e-6)


def test_default_price_is_the_engines_best_specific_fuel(paper: PowertrainParams):
    assert best_specific_fuel_kg_per_j(paper) == pytest.approx(1 / (0.437 * 42.8e6), rel=1e-12)
    assert resolve(EQUIVALENT, paper).lambda0_kg_per_j == best_specific_fuel_kg_per_j(paper)
    given = replace(EQUIVALENT, lambda0_kg_per_j=6e-8)
    assert resolve(given, paper).lambda0_kg_per_j == 6e-8


def test_battery_prices_of_a_run_telescope_to_its_ends(paper: PowertrainParams):
    rng = np.random.default_rng(1)
    soc = 0.8 + np.cumsum(rng.normal(0.0, 2e-4, 767))
    target = np.array(0.836)
    parts = battery_price(EQUIVALENT, paper, soc[:-1], soc[1:], target)
    whole = battery_price(EQUIVALENT, paper, soc[0], soc[-1], target)
    assert parts.sum() == pytest.approx(float(whole), rel=1e-9)
    assert np.abs(parts).sum() > 10 * abs(float(whole))


def test_battery_energy_is_dearer_below_the_target(paper: PowertrainParams):
    soc = np.array([0.80, 0.836, 0.87])
    price = battery_price(EQUIVALENT, paper, soc, soc - 1e-6, np.array(0.836)) / 1e-6
    at_target = paper.battery.energy_j * best_specific_fuel_kg_per_j(paper)
    expected = at_target * (1.0 + EQUIVALENT.kp * np.array([0.036, 0.0, -0.034]))
    assert price == pytest.approx(expected, rel=1e-5)


def test_equal_final_soc_orders_runs_by_fuel_alone(paper: PowertrainParams):
    """Two ways from 0.85 to 0.84, one of them twice as thirsty."""
    straight, detour = np.array([0.85, 0.845, 0.84]), np.array([0.85, 0.86, 0.84])

    def total(soc: np.ndarray, fuel_kg: np.ndarray) -> float:
        on = np.ones(2, dtype=bool)
        rewards = step_reward(
            EQUIVALENT,
            paper,
            fuel_kg=fuel_kg,
            engine_power_w=np.full(2, 150e3),
            engine_on=on,
            engine_started=~on,
            soc=soc[:-1],
            soc_next=soc[1:],
            soc_target=np.full(2, 0.836),
        )
        return float(rewards.sum())

    cheap, dear = np.array([0.008, 0.008]), np.array([0.016, 0.016])
    assert total(straight, cheap) == pytest.approx(total(detour, cheap), rel=1e-9)
    assert total(straight, cheap) - total(detour, dear) == pytest.approx(0.016, rel=1e-6)


def test_fuel_reward_is_the_recorded_fuel_and_nothing_else(paper: PowertrainParams):
    fuel = np.array([0.0, 0.008])
    rewards = step_reward(
        RewardConfig(kind="fuel"),
        paper,
        fuel_kg=fuel,
        engine_power_w=np.array([0.0, 150e3]),
        engine_on=np.array([False, True]),
        engine_started=np.array([False, True]),
        soc=np.array([0.8, 0.7]),
        soc_next=np.array([0.7, 0.8]),
        soc_target=np.array([0.8, 0.8]),
    )
    assert np.array_equal(rewards, -fuel)


def test_a_start_costs_the_larger_of_plant_and_price(paper: PowertrainParams):
    thirsty = replace(paper, engine=replace(paper.engine, start_fuel_kg=0.015))
    assert start_cost(EQUIVALENT, paper) == EQUIVALENT.start_price_kg > 0.0
    assert start_cost(EQUIVALENT, thirsty) == 0.015
    assert start_cost(RewardConfig(kind="fuel"), thirsty) == 0.015
    assert start_cost(RewardConfig(kind="piecewise"), thirsty) == 0.0


def test_running_cost_is_what_the_plant_burns(paper: PowertrainParams):
    power = np.array([[0.0, 150e3], [1.0, 275e3]])
    burnt = power / (np.array([[1.0, 0.437], [0.050005, 0.39]]) * 42.8e6)
    assert running_cost(EQUIVALENT, paper, power) == pytest.approx(burnt, rel=1e-9)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("kind", "profit"),
        ("kp", -1.0),
        ("kp", float("nan")),
        ("lambda0_kg_per_j", 0.0),
        ("start_price_kg", 2.0),
    ],
)
def test_a_reward_setting_out_of_range_is_named(field: str, value: object):
    with pytest.raises(ConfigError, match=rf"reward\.{field}: .*allowed"):
        replace(EQUIVALENT, **{field: value})  # type: ignore[arg-type]
