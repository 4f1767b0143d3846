"""No run of a plant with engine state beats its DP: a ratio above 1.0005 is a bug there."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tractor_ems.drive import drive
from tractor_ems.optimal import engine_certificate
from tractor_ems.optimal.engine_dp import relaxed, solve_engine
from tractor_ems.optimal.score import dp_ratio
from tractor_ems.policies.planned import PlannedPolicy
from tractor_ems.policies.registry import RULES, make_rule
from tractor_msgs_py.errors import ConfigError, TractorEmsError
from tractor_msgs_py.trajectory import FloatArray, Trajectory
from tractor_sim.config import load_powertrain
from tractor_sim.duty_cycle.generate import OPERATIONS, generate
from tractor_sim.duty_cycle.library import cycle_names, load_cycle
from tractor_sim.powertrain import PowertrainParams

BOUND = 1.0005
FIELD = load_powertrain("field")
PLANTS = (
    FIELD,
    relaxed(FIELD),
    load_powertrain("field:engine.start_fuel_kg=0.0"),
    load_powertrain("field:engine.start_fuel_kg=0.06,engine.curve=fixed_1800_rpm"),
    load_powertrain("wheel_loader"),
    load_powertrain("paper:engine.start_fuel_kg=0.02"),
)


def random_demand_w(rng: np.random.Generator, params: PowertrainParams) -> FloatArray:
    """60-200 s of noise, light work with braking, steps, or a stretch of an operation; scaled to
    the engine."""
    steps, kind = int(rng.integers(60, 201)), rng.integers(4)
    if kind == 0:
        demand_w = rng.uniform(-80e3, 230e3, steps)
    elif kind == 1:
        demand_w = np.clip(rng.normal(30e3, 20e3, steps), -20e3, 200e3)
    elif kind == 2:
        demand_w = np.repeat(rng.uniform(-50e3, 230e3, steps // 10 + 1), 10)[:steps]
    else:
        operation = OPERATIONS[int(rng.integers(len(OPERATIONS)))]
        work = generate(operation, int(rng.integers(1000)), duration_s=600)
        begin = int(rng.integers(600 - steps))
        demand_w = work.power_demand_w[begin : begin + steps]
    return demand_w * (params.engine.power_max_w / 275e3) + params.p_aux_w


def random_plan(
    rng: np.random.Generator, params: PowertrainParams, demand_w: FloatArray
) -> PlannedPolicy:
    """Powers held for a while, some of them off; or near the demand, which keeps the battery."""
    held_s = int(rng.choice([1, 5, 20]))
    values_w = rng.uniform(0.0, params.engine.power_max_w, len(demand_w) // held_s + 1)
    values_w[rng.random(len(values_w)) < 0.3] = 0.0
    power_w = np.repeat(values_w, held_s)[: len(demand_w)]
    if rng.random() < 0.5:
        power_w = np.clip(demand_w + rng.normal(0.0, 10e3, len(demand_w)), 0.0, None)
    return PlannedPolicy(params, demand_w, power_w, power_w > 0.0, name="random")


def ratio_of(params: PowertrainParams, demand_w: FloatArray, run: Trajectory) -> float | None:
    return dp_ratio(
        params,
        demand_w,
        float(run.soc[0]),
        run.soc_final,
        float(run.fuel_kg.sum()),
        shortfall_j=float(run.shortfall_j.sum()),
    )


def check_that_nothing_beats_dp(plant: int, policy: str, where: float, seed: int) -> None:
    rng, params = np.random.default_rng(seed), PLANTS[plant]
    demand_w = random_demand_w(rng, params)
    soc_min, soc_max = params.battery.soc_min, params.battery.soc_max
    soc = soc_min + where * (soc_max - soc_min)
    made: Any = (
        random_plan(rng, params, demand_w) if policy == "random" else make_rule(policy, params)
    )
    run = drive(made, params, demand_w[None, :], soc, soc)[0]
    ratio = ratio_of(params, demand_w, run)
    if run.shortfall_j.sum() > 0.0:
        assert ratio is None
    else:
        assert ratio is not None
        assert 0.0 <= ratio <= BOUND


cases = given(
    plant=st.integers(0, len(PLANTS) - 1),
    policy=st.sampled_from(["random", "random", *RULES]),
    where=st.sampled_from([0.0, 0.01, 0.1, 0.5, 0.9, 0.99, 1.0]),
    seed=st.integers(0, 2**32 - 1),
)


@settings(max_examples=8, deadline=None)
@cases
def test_nothing_beats_dp(plant, policy, where, seed):
    check_that_nothing_beats_dp(plant, policy, where, seed)


@pytest.mark.slow
@settings(max_examples=400, deadline=None)
@cases
def test_nothing_beats_dp_in_many_more_runs(plant, policy, where, seed):
    check_that_nothing_beats_dp(plant, policy, where, seed)


@pytest.mark.slow
@pytest.mark.parametrize("name", cycle_names("held_out")[3::13])
@pytest.mark.parametrize("policy", RULES)
def test_no_rule_beats_dp_on_held_out_work(name, policy):
    demand_w = load_cycle(name).power_demand_w + FIELD.p_aux_w
    run = drive(make_rule(policy, FIELD), FIELD, demand_w[None, :], 0.55, 0.55)[0]
    ratio = ratio_of(FIELD, demand_w, run)
    assert ratio is None or ratio <= BOUND


@pytest.mark.slow
@pytest.mark.parametrize("name", ["loader_2010", "tandem_disk_1009", "rotary_hoe_2003"])
def test_a_finer_optimum_of_the_relaxed_plant_does_not_beat_the_reference(name):
    """The strongest rival: DP itself with cells eight times finer, driven on the relaxed plant."""
    demand_w = load_cycle(name).power_demand_w + FIELD.p_aux_w
    plan = solve_engine(FIELD, demand_w, 0.55, 0.55, cell_j=10e3).plan
    policy = PlannedPolicy(FIELD, demand_w, plan.engine_power_w, plan.engine_on)
    run = drive(policy, relaxed(FIELD), demand_w[None, :], 0.55, 0.55)[0]
    ratio = ratio_of(relaxed(FIELD), demand_w, run)
    assert ratio is not None
    assert 0.999 < ratio <= 1.0002


def test_the_optimum_that_the_relaxed_plant_drives_scores_one():
    demand_w = generate("loader", 4, duration_s=600).power_demand_w[:120] + FIELD.p_aux_w
    plan = solve_engine(FIELD, demand_w, 0.55, 0.55).plan
    policy = PlannedPolicy(FIELD, demand_w, plan.engine_power_w, plan.engine_on)
    run = drive(policy, relaxed(FIELD), demand_w[None, :], 0.55, 0.55)[0]
    assert ratio_of(FIELD, demand_w, run) == pytest.approx(1.0, abs=1e-4)


def test_ramp_and_minimum_times_do_not_change_the_reference():
    """They are not in the lower bound: dp_ratio can only be hard on a run."""
    demand_w = generate("baler", 4, duration_s=600).power_demand_w[:60] + FIELD.p_aux_w
    real, without = (dp_ratio(p, demand_w, 0.55, 0.552, 2.0) for p in (FIELD, relaxed(FIELD)))
    assert real == without


def test_soc_from_the_wire_scores_like_exact_soc():
    demand_w = np.full(40, 90e3)
    exact = dp_ratio(FIELD, demand_w, 0.55, 0.5487654321, 1.0)
    wire = dp_ratio(FIELD, demand_w, 0.55, float(np.float32(0.5487654321)), 1.0)
    assert wire == pytest.approx(exact, abs=1e-5)


def test_a_final_soc_the_cycle_cannot_reach_is_refused():
    with pytest.raises(ConfigError, match="cannot be reached"):
        dp_ratio(FIELD, np.full(10, 50e3), 0.4, 0.8, 1.0)


def test_an_uncertified_reference_is_not_a_score(monkeypatch):
    monkeypatch.setattr(engine_certificate, "HALVING_LIMIT", 0.0)
    with pytest.raises(TractorEmsError, match="not certified"):
        dp_ratio(FIELD, np.full(20, 70e3), 0.55, 0.5512345, 1.0)
