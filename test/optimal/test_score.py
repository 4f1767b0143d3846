"""The matched-SOC DP ratio: no policy beats it, and undelivered work does not score."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tractor_ems.drive import drive
from tractor_ems.optimal import certificate
from tractor_ems.optimal.score import dp_ratio
from tractor_ems.policies.protocol import ANY_RUN
from tractor_ems.policies.rules import BestPoint, Conventional, MyopicGreedy, RuleBased
from tractor_msgs_py.errors import ConfigError, TractorEmsError
from tractor_msgs_py.observation import Observation, ObservationSpec
from tractor_msgs_py.trajectory import FloatArray, Trajectory
from tractor_sim.config import load_powertrain
from tractor_sim.duty_cycle.library import load_cycle
from tractor_sim.powertrain import Command, PowertrainParams

BOUND = 1.0005
"""A ratio above this is a bug in the DP, not a tolerance to widen."""

PAPER = load_powertrain("paper")
PLANTER_W = load_cycle("planter").power_demand_w


def with_battery(energy_j: float, power_max_w: float, soc_min: float, soc_max: float):
    battery = dataclasses.replace(
        PAPER.battery,
        energy_j=energy_j,
        power_max_w=power_max_w,
        soc_min=soc_min,
        soc_max=soc_max,
    )
    return dataclasses.replace(PAPER, battery=battery, soc_initial=0.5 * (soc_min + soc_max))


PLANTS = [PAPER, with_battery(144e6, 150e3, 0.3, 0.8), with_battery(18e6, 100e3, 0.2, 0.9)]


@dataclasses.dataclass(frozen=True)
class EnginePowers:
    """Asks for the powers of a list, one after the other, 0 for off."""

    powers_w: FloatArray
    name: str = "engine_powers"
    spec: ObservationSpec = ANY_RUN

    def init(self, batch: int) -> int:
        return 0

    def act(self, observation: Observation, state: int) -> tuple[Command, int]:
        engine_w = self.powers_w[state % len(self.powers_w)]
        off = np.full(len(observation.soc), 0.0 if engine_w == 0.0 else np.nan)
        return Command(observation.power_demand_w - engine_w, off), state + 1


def policies(params: PowertrainParams, rng: np.random.Generator) -> list[Any]:
    held = np.repeat(rng.choice([0.0, 60e3, 110e3, 150e3, 190e3, 275e3], 40), 5)
    return [
        Conventional(),
        BestPoint(params),
        RuleBased(params),
        RuleBased(params, soc_guard=False),
        MyopicGreedy(params),
        EnginePowers(np.array([150e3])),
        EnginePowers(rng.uniform(0.0, 275e3, 1)),
        EnginePowers(rng.uniform(-50e3, 275e3, 200)),
        EnginePowers(held),
    ]


def random_demand_w(rng: np.random.Generator) -> FloatArray:
    """60-200 s of noise, light work with braking, steps, or constant demand."""
    steps = int(rng.integers(60, 201))
    kind = rng.integers(4)
    if kind == 0:
        return rng.uniform(-80e3, 270e3, steps)
    if kind == 1:
        return np.clip(rng.normal(30e3, 20e3, steps), -20e3, 200e3)
    if kind == 2:
        return np.repeat(rng.uniform(-50e3, 260e3, steps // 10 + 1), 10)[:steps]
    return np.full(steps, rng.uniform(-20e3, 260e3))


def ratio_of(params: PowertrainParams, demand_w: FloatArray, run: Trajectory) -> float | None:
    return dp_ratio(
        params,
        demand_w,
        float(run.soc[0]),
        run.soc_final,
        float(run.fuel_kg.sum()),
        shortfall_j=float(run.shortfall_j.sum()),
    )


def check_that_nothing_beats_dp(plant: int, policy: int, where: float, seed: int) -> None:
    rng, params = np.random.default_rng(seed), PLANTS[plant]
    demand_w = random_demand_w(rng)
    soc_min, soc_max = params.battery.soc_min, params.battery.soc_max
    soc = soc_min + where * (soc_max - soc_min)
    run = drive(policies(params, rng)[policy], params, demand_w[None, :], soc, soc)[0]
    ratio = ratio_of(params, demand_w, run)
    if run.shortfall_j.sum() > 0.0:
        assert ratio is None
    else:
        assert ratio is not None
        assert 0.0 <= ratio <= BOUND


cases = given(
    plant=st.integers(0, len(PLANTS) - 1),
    policy=st.integers(0, 8),
    where=st.sampled_from([0.0, 0.01, 0.1, 0.5, 0.9, 0.99, 1.0]),
    seed=st.integers(0, 2**32 - 1),
)


@settings(max_examples=15, deadline=None)
@cases
def test_nothing_beats_dp(plant, policy, where, seed):
    check_that_nothing_beats_dp(plant, policy, where, seed)


@pytest.mark.slow
@settings(max_examples=500, deadline=None)
@cases
def test_nothing_beats_dp_in_many_more_runs(plant, policy, where, seed):
    check_that_nothing_beats_dp(plant, policy, where, seed)


@pytest.mark.parametrize(
    "policy", [2, *(pytest.param(n, marks=pytest.mark.slow) for n in (4, 7, 8))]
)
def test_nothing_beats_dp_on_the_paper_cycle(policy):
    """Conventional and best point have tests of their own below."""
    made = policies(PAPER, np.random.default_rng(5))[policy]
    run = drive(made, PAPER, PLANTER_W[None, :], 0.85, 0.836)[0]
    ratio = ratio_of(PAPER, PLANTER_W, run)
    assert ratio is not None
    assert 0.0 < ratio <= BOUND


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_nothing_beats_dp_in_half_an_hour_of_light_work_on_a_small_battery(seed):
    """Coarse cells let causal runs win by 0.1-0.5 % here."""
    rng, params = np.random.default_rng(seed), PLANTS[1]
    passes = (np.arange(1800) + 17 * seed) % 72 < 33
    demand_w = np.where(passes, rng.normal(110e3, 15e3, 1800), rng.normal(25e3, 5e3, 1800))
    for policy in policies(params, rng):
        run = drive(policy, params, demand_w[None, :], 0.55, 0.55)[0]
        ratio = ratio_of(params, demand_w, run)
        assert ratio is None or ratio <= BOUND


def test_best_point_is_the_optimum_on_the_paper_cycle():
    run = drive(BestPoint(PAPER), PAPER, PLANTER_W[None, :], 0.85, 0.85)[0]
    assert ratio_of(PAPER, PLANTER_W, run) == pytest.approx(1.0, abs=3e-4)


def test_conventional_loses_what_the_closed_form_says():
    """Same final SOC, so the best ratio is mean efficiency over best efficiency."""
    run = drive(Conventional(), PAPER, PLANTER_W[None, :], 0.85, 0.85)[0]
    fuel_kg = float(run.fuel_kg.sum())
    efficiency = run.engine_power_w.sum() / (fuel_kg * PAPER.engine.fuel_lhv_j_per_kg)
    assert run.soc_final == pytest.approx(0.85, abs=1e-9)
    assert ratio_of(PAPER, PLANTER_W, run) == pytest.approx(efficiency / 0.437, abs=3e-4)


def test_shortfall_does_not_score():
    demand_w = np.array([50e3, 600e3, 80e3])
    run = drive(Conventional(), PAPER, demand_w[None, :], 0.85, 0.85)[0]
    assert run.shortfall_j.sum() > 0.0
    assert ratio_of(PAPER, demand_w, run) is None


def test_a_run_without_fuel_cannot_be_beaten():
    assert dp_ratio(PAPER, np.full(30, 20e3), 0.85, 0.85 - 30 * 20e3 / 666e6, 0.0) == 1.0


@pytest.mark.parametrize(("soc_initial", "soc_final"), [(0.9, 0.9), (0.7, 0.7), (0.8985, 0.9)])
def test_a_final_soc_at_a_limit_is_scored(soc_initial, soc_final):
    """The engine's own power is constant, so the best any run can do is known."""
    demand_w = np.full(60, 170e3)
    engine_w = 170e3 + (soc_final - soc_initial) * PAPER.battery.energy_j / 60
    run = drive(EnginePowers(np.array([engine_w])), PAPER, demand_w[None, :], soc_initial, 0.85)[0]
    assert run.soc_final == pytest.approx(soc_final, abs=1e-9)
    assert ratio_of(PAPER, demand_w, run) == pytest.approx(1.0, abs=3e-4)


def test_an_all_out_charge_leaves_no_choice():
    demand_w = np.random.default_rng(3).uniform(30e3, 270e3, 80)
    run = drive(EnginePowers(np.array([275e3])), PAPER, demand_w[None, :], 0.75, 0.85)[0]
    assert ratio_of(PAPER, demand_w, run) == pytest.approx(1.0, abs=1e-6)


def test_soc_from_the_wire_scores_like_exact_soc():
    run = drive(RuleBased(PAPER), PAPER, PLANTER_W[None, :], 0.85, 0.85)[0]
    exact = ratio_of(PAPER, PLANTER_W, run)
    wire = dp_ratio(
        PAPER,
        PLANTER_W,
        float(run.soc_observed[0]),
        float(np.float32(run.soc_final)),
        float(run.fuel_kg.sum()),
    )
    assert wire == pytest.approx(exact, abs=1e-5)


@pytest.mark.parametrize("fuel_kg", [-1.0, float("nan"), float("inf")])
def test_fuel_that_is_no_amount_is_refused(fuel_kg):
    with pytest.raises(ConfigError, match="run_fuel_kg"):
        dp_ratio(PAPER, PLANTER_W, 0.85, 0.85, fuel_kg)


def test_a_final_soc_the_cycle_cannot_reach_is_refused():
    with pytest.raises(ConfigError, match="cannot be reached"):
        dp_ratio(PAPER, np.full(10, 50e3), 0.7, 0.85, 1.0)


def test_an_uncertified_reference_is_not_a_score(monkeypatch):
    monkeypatch.setattr(certificate, "MAX_NODES", 2_000)
    with pytest.raises(TractorEmsError, match="not certified with 7 SOC points"):
        dp_ratio(PLANTS[2], PLANTER_W[:200], 0.5, 0.5, 1.0, soc_points=4, actions=2)
