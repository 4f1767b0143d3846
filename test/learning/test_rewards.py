"""The rewards: the paper's as printed, and a price of battery energy that telescopes."""

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest

from tractor_ems.learning.config import load_train_config
from tractor_ems.learning.mdp import make_mdp, reward_of
from tractor_ems.learning.rewards import (
    RewardConfig,
    RewardKind,
    battery_price,
    best_fuel_kg,
    best_specific_fuel_kg_per_j,
    piecewise_reward,
    resolve,
    running_cost,
    start_cost,
    step_reward,
)
from tractor_msgs_py.errors import ConfigError
from tractor_sim.engine import fuel_rate_kg_per_s
from tractor_sim.powertrain import PowertrainParams

EQUIVALENT = RewardConfig()
CORRECTED = RewardConfig(kind="piecewise_corrected")


@pytest.mark.parametrize(
    ("power_w", "reward"),
    [
        (0.0, 2.46),
        (1e-6, -0.58 - 0.22 - 0.05),
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
        (190e3 + 1.0, -0.06 - 6e-6 - (0.425 - 0.015 / 40e3)),
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


def test_piecewise_reward_drops_from_1_425_to_minus_0_485_just_above_190_kw(
    paper: PowertrainParams,
):
    edge = piecewise_reward(paper.engine, np.array([190e3, np.nextafter(190e3, np.inf)]))
    assert edge == pytest.approx([1.425, -0.485], abs=1e-9)


def test_piecewise_reward_at_exactly_275_kw_is_minus_2_and_just_below_it_is_not(
    paper: PowertrainParams,
):
    edge = piecewise_reward(paper.engine, np.array([np.nextafter(275e3, 0.0), 275e3]))
    assert edge == pytest.approx([-0.96, -2.0], abs=1e-9)


BEST_KG = 150e3 / (0.437 * 42.8e6)


def corrected(
    params: PowertrainParams, power_w: float, soc: float = 0.836, soc_next: float = 0.836
) -> float:
    """The corrected reward of a step that keeps the target SOC unless told otherwise."""
    power = np.array([power_w])
    on = power > 0.0
    rewards = step_reward(
        CORRECTED,
        params,
        fuel_kg=fuel_rate_kg_per_s(params.engine, power) * params.dt_s,
        engine_power_w=power,
        engine_on=on,
        engine_started=on,
        soc=np.array([soc]),
        soc_next=np.array([soc_next]),
        soc_target=np.array([0.836]),
    )
    return float(rewards[0])


@pytest.mark.parametrize(
    ("power_w", "reward"),
    [
        (0.0, 0.0),
        (1e-9, -0.22),
        (10e3, -(10e3 / (0.10 * 42.8e6) / BEST_KG + 0.20)),
        (60e3, -(60e3 / (0.25 * 42.8e6) / BEST_KG + 0.10)),
        (110e3 - 1e-6, -(110e3 / (0.42 * 42.8e6) / BEST_KG)),
        (110e3, -(110e3 / (0.42 * 42.8e6) / BEST_KG)),
        (150e3, -1.0),
        (190e3, -(190e3 / (0.425 * 42.8e6) / BEST_KG)),
        (190e3 + 1e-6, -(190e3 / (0.425 * 42.8e6) / BEST_KG)),
        (230e3, -(230e3 / (0.41 * 42.8e6) / BEST_KG + 0.24)),
        (275e3, -(275e3 / (0.39 * 42.8e6) / BEST_KG + 0.51)),
    ],
)
def test_corrected_reward_by_hand_and_without_jumps(
    paper: PowertrainParams, power_w: float, reward: float
):
    assert corrected(paper, power_w) == pytest.approx(reward, abs=1e-8)


def test_under_the_corrected_reward_a_joule_costs_the_same_from_battery_and_best_point(
    paper: PowertrainParams,
):
    """Engine off is neutral: one second of 150 kW out of the battery is no gain and no loss."""
    taken = 150e3 / paper.battery.energy_j
    from_battery = corrected(paper, 0.0, 0.836 + taken / 2, 0.836 - taken / 2)
    assert from_battery == pytest.approx(corrected(paper, 150e3), rel=1e-9)
    assert corrected(paper, 0.0, 0.80, 0.80 - taken) < from_battery


@pytest.mark.parametrize("power_w", [5e3, 60e3, 109e3, 150e3, 189e3, 200e3, 270e3])
def test_corrected_reward_rises_with_efficiency_at_every_power(
    paper: PowertrainParams, power_w: float
):
    """2 % better everywhere but at the best point, whose fuel is the unit of the reward."""
    engine = paper.engine
    curve = tuple(e if e == 0.437 else 1.02 * e for e in engine.curve_efficiency)
    better = replace(paper, engine=replace(engine, curve_efficiency=curve))
    assert best_fuel_kg(better) == best_fuel_kg(paper)
    if power_w == 150e3:
        assert corrected(better, power_w) == corrected(paper, power_w)
    else:
        assert corrected(better, power_w) > corrected(paper, power_w) + 1e-4


@pytest.mark.parametrize("kind", ["fuel", "piecewise", "piecewise_corrected", "equivalent_fuel"])
def test_a_recorded_step_earns_minus_the_three_parts_of_its_cost(
    paper: PowertrainParams, kind: str
):
    """All-action backups add the parts, replay reads the recording: one definition."""
    plant = replace(paper, engine=replace(paper.engine, start_fuel_kg=0.004))
    config = RewardConfig(kind=kind)  # type: ignore[arg-type]
    power = np.array([0.0, 20e3, 110e3, 150e3, 200e3, 275e3])
    on, started = power > 0.0, np.array([False, True, False, False, True, False])
    soc, soc_next = np.full(6, 0.82), np.array([0.8195, 0.8199, 0.82, 0.8201, 0.8202, 0.8203])
    target = np.full(6, 0.836)
    burnt_kg = fuel_rate_kg_per_s(plant.engine, power) + np.where(started, 0.004, 0.0)
    rewards = step_reward(
        config,
        plant,
        fuel_kg=burnt_kg,
        engine_power_w=power,
        engine_on=on,
        engine_started=started,
        soc=soc,
        soc_next=soc_next,
        soc_target=target,
    )
    cost = running_cost(config, plant, power) + np.where(started, start_cost(config, plant), 0.0)
    cost += battery_price(config, plant, soc, soc_next, target)
    assert rewards == pytest.approx(-cost, rel=1e-12)


@pytest.mark.parametrize("kind", ["fuel", "piecewise", "piecewise_corrected", "equivalent_fuel"])
def test_the_compiled_environment_pays_the_same_reward(paper: PowertrainParams, kind: str):
    config = RewardConfig(kind=kind, start_price_kg=0.0)  # type: ignore[arg-type]
    rng = np.random.default_rng(5)
    edges = [0.0, 1.0, 110e3 - 1e-3, 110e3, 190e3, 190e3 + 1e-3, 275e3 - 1e-3, 275e3]
    power = np.concatenate([edges, rng.uniform(0.0, 275e3, 200)])
    soc = rng.uniform(0.70, 0.90, len(power))
    soc_next = soc + rng.uniform(-3e-4, 3e-4, len(power))
    on, fuel_kg = power > 0.0, fuel_rate_kg_per_s(paper.engine, power)
    mdp = make_mdp(
        paper,
        np.array([143e3]),
        config,
        mapping="p_batt_grid",
        actions=1600,
        soc_initial=0.85,
        soc_target=0.836,
    )
    compiled = [reward_of(mdp, *row) for row in zip(power, fuel_kg, soc, soc_next, strict=True)]
    rewards = step_reward(
        config,
        paper,
        fuel_kg=fuel_kg,
        engine_power_w=power,
        engine_on=on,
        engine_started=~on & False,
        soc=soc,
        soc_next=soc_next,
        soc_target=np.full(len(power), 0.836),
    )
    assert compiled == pytest.approx(list(rewards / config.cost_unit), rel=1e-10, abs=1e-12)


def test_default_price_is_the_engines_best_specific_fuel(paper: PowertrainParams):
    assert best_specific_fuel_kg_per_j(paper) == pytest.approx(1 / (0.437 * 42.8e6), rel=1e-12)
    assert resolve(EQUIVALENT, paper).lambda0_kg_per_j == best_specific_fuel_kg_per_j(paper)
    given = replace(EQUIVALENT, lambda0_kg_per_j=6e-8)
    assert resolve(given, paper).lambda0_kg_per_j == 6e-8


@pytest.mark.parametrize("config", [EQUIVALENT, CORRECTED])
def test_battery_prices_of_a_run_telescope_to_its_ends(
    paper: PowertrainParams, config: RewardConfig
):
    rng = np.random.default_rng(1)
    soc = 0.8 + np.cumsum(rng.normal(0.0, 2e-4, 767))
    target = np.array(0.836)
    parts = battery_price(config, paper, soc[:-1], soc[1:], target)
    whole = battery_price(config, paper, soc[0], soc[-1], target)
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


def test_training_settings_take_every_reward_by_name():
    for kind in get_args(RewardKind):
        assert load_train_config(None, {"reward.kind": kind}).reward.kind == kind
    with pytest.raises(ConfigError, match="piecewise_corrected"):
        load_train_config(None, {"reward.kind": "profit"})
