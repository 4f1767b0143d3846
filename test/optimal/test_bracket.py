"""The bracket: what the real plant drives keeps its limits and is close to the lower bound."""

import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tractor_ems.drive import drive
from tractor_ems.optimal import engine_dp
from tractor_ems.optimal.bracket import drive_plan, plan_policy
from tractor_ems.optimal.certificate import BRACKET_LIMIT, HALVING_LIMIT, ROLLOUT_LIMIT, certify
from tractor_ems.optimal.dp import engine_knots_w
from tractor_ems.optimal.engine_dp import nearest_end_soc, relaxed, solve_engine
from tractor_ems.policies.planned import PlannedPolicy
from tractor_msgs_py.errors import ConfigError, RunAborted
from tractor_msgs_py.observation import ObservationBuilder
from tractor_msgs_py.trajectory import FloatArray, Trajectory
from tractor_msgs_py.types import DEFAULT_T0_NS, PowerDemand, RunInfo
from tractor_sim.config import load_powertrain
from tractor_sim.duty_cycle.generate import generate
from tractor_sim.duty_cycle.library import cycle_names, load_cycle
from tractor_sim.generator import to_crank_w
from tractor_sim.powertrain import PowertrainParams, initial_state, step
from tractor_sim.readings import battery_reading, powertrain_reading

FIELD = load_powertrain("field")


def generated_w(operation: str, seed: int, steps: int = 600) -> FloatArray:
    return generate(operation, seed, duration_s=steps).power_demand_w + FIELD.p_aux_w


def with_engine(**changes: float) -> PowertrainParams:
    return dataclasses.replace(FIELD, engine=dataclasses.replace(FIELD.engine, **changes))


def jumping_w(steps: int = 240) -> FloatArray:
    """Between 8 kW and 230 kW at once, which takes an engine that has ramped up beforehand."""
    work = (np.arange(steps) % 60 >= 30) & (np.arange(steps) >= 30)
    return np.where(work, 230e3, 8e3)


def durations(on: np.ndarray, state: bool) -> list[int]:
    """Steps of every whole stretch in a state: begun and ended within the run."""
    edges = np.flatnonzero(np.diff(on.astype(int)))
    return [
        int(end - begin)
        for begin, end in itertools.pairwise(edges)
        if bool(on[begin + 1]) is state
    ]


def check_limits_kept(params: PowertrainParams, run: Trajectory) -> None:
    crank_w = to_crank_w(params.generator, run.engine_power_w, params.engine.power_max_w)
    before_w = np.append(0.0, crank_w[:-1])
    ramps_w = np.abs(crank_w - before_w)[run.engine_on]
    assert ramps_w.max() <= params.engine.ramp_w_per_s * params.dt_s + 1.0
    assert min(durations(run.engine_on, True), default=99) >= params.engine.min_on_s
    assert min(durations(run.engine_on, False), default=99) >= params.engine.min_off_s
    assert run.shortfall_j.sum() == 0.0


@pytest.mark.parametrize(
    ("params", "demand_w"),
    [
        (FIELD, jumping_w()),
        (with_engine(start_fuel_kg=0.0), generated_w("loader", 3, 300)),
        pytest.param(
            with_engine(ramp_w_per_s=20e3, min_on_s=20.0, min_off_s=30.0),
            generated_w("loader", 3, 300),
            marks=pytest.mark.slow,
        ),
    ],
)
def test_the_plan_fits_ramp_and_minimum_times_and_ends_where_it_should(params, demand_w):
    solution = solve_engine(params, demand_w, 0.55, 0.55)
    policy, run = plan_policy(params, solution), drive_plan(params, solution)
    check_limits_kept(params, run)
    assert run.soc_final == pytest.approx(0.55, abs=1e-6)
    # The plant does what was planned: nothing is cut, nothing is held on.
    np.testing.assert_array_equal(run.engine_on, policy.engine_on)
    np.testing.assert_allclose(run.engine_power_w, policy.engine_power_w, atol=1.0)
    assert run.fuel_kg.sum() >= solution.lower_bound_kg * (1.0 - 1e-5)


def test_an_engine_that_is_slow_is_started_before_the_battery_is_at_its_limit():
    """230 kW are 80 more than the battery gives: two steps of ramp."""
    demand_w = jumping_w()
    run = drive_plan(FIELD, solve_engine(FIELD, demand_w, 0.55, 0.55))
    jumps = np.flatnonzero(np.diff(demand_w) > 200e3)
    assert len(jumps) == 4
    assert np.all(run.engine_power_w[jumps] > 15e3)


@pytest.mark.parametrize("operation", ["loader", pytest.param("baler", marks=pytest.mark.slow)])
def test_the_certificate_holds_on_generated_work(operation):
    certificate = certify(FIELD, generated_w(operation, 5, 300), 0.55, 0.55)
    assert certificate.ok
    assert certificate.grid_halving_change < HALVING_LIMIT
    assert abs(certificate.rollout_gap) <= ROLLOUT_LIMIT
    assert certificate.bracket_width is not None
    assert -1e-5 <= certificate.bracket_width <= BRACKET_LIMIT
    assert certificate.soc_final == pytest.approx(0.55, abs=1e-6)


def test_without_ramp_and_minimum_times_the_bracket_is_closed():
    certificate = certify(relaxed(FIELD), generated_w("loader", 5, 120), 0.55, 0.55)
    assert certificate.bracket_width == pytest.approx(0.0, abs=2e-5)


def test_demand_that_no_slow_engine_can_meet_leaves_the_bracket_open():
    """From standstill 60 kW are reached in a second; 290 kW need 140."""
    certificate = certify(FIELD, np.full(60, 290e3), 0.55, 0.52)
    assert certificate.bracket_width is None
    assert not certificate.ok


def test_a_final_soc_out_of_reach_is_named_with_the_nearest():
    with pytest.raises(ConfigError, match=r"soc_final: 0.8 cannot be reached from 0.4 .* 0.41"):
        certify(FIELD, np.full(10, 50e3), 0.4, 0.8)


@pytest.mark.slow
@pytest.mark.parametrize("name", cycle_names("held_out")[::7])
def test_the_certificate_holds_on_held_out_work(name):
    demand_w = load_cycle(name).power_demand_w + FIELD.p_aux_w
    assert certify(FIELD, demand_w, 0.55, 0.55).ok


def test_one_observation_at_a_time_gives_the_commands_of_the_in_process_run():
    demand_w = generated_w("loader", 3, 120)
    solution = solve_engine(FIELD, demand_w, 0.55, 0.55)
    policy, run = plan_policy(FIELD, solution), drive_plan(FIELD, solution)
    builder = ObservationBuilder(policy.spec)
    info = RunInfo(
        run_id="run",
        cycle="loader",
        cycle_hash="",
        powertrain="field",
        powertrain_hash="",
        t0_ns=DEFAULT_T0_NS,
        dt_s=1.0,
        steps=120,
        p_aux_w=FIELD.p_aux_w,
        soc_initial=0.55,
        soc_target=0.55,
    )
    builder.start_run(info)
    state, last, memory = initial_state(FIELD, 0.55), None, policy.init(1)
    for k, power_w in enumerate(demand_w):
        stamp_ns = info.stamp_ns(k)
        builder.add(PowerDemand(stamp_ns, float(power_w)))
        builder.add(battery_reading(FIELD, state, last, stamp_ns))
        observation = builder.add(powertrain_reading(FIELD, state, last, stamp_ns))
        assert observation is not None
        command, memory = policy.act(observation, memory)
        assert command.battery_power_w[0] == run.command_battery_power_w[k]
        state, last = step(FIELD, state, observation.power_demand_w, command)
    assert state.soc[0] == run.soc_final


def test_another_demand_stops_the_run():
    demand_w = generated_w("loader", 3, 60)
    policy = plan_policy(FIELD, solve_engine(FIELD, demand_w, 0.55, 0.55))
    other_w = demand_w.copy()
    other_w[7] += 1.0
    with pytest.raises(RunAborted, match="tick 7"):
        drive(policy, FIELD, other_w[None, :], 0.55, 0.55)


SHORT = (
    relaxed(load_powertrain("utility_150kw")),
    relaxed(FIELD),
    FIELD,
)


def reachable_end(params: PowertrainParams, demand_w: FloatArray, soc: float, u: float) -> float:
    """The end a share ``u`` of the way from the lowest that can be reached to the highest."""
    window = params.battery.soc_min, params.battery.soc_max
    low, high = (nearest_end_soc(params, demand_w, soc, end) for end in window)
    return low + u * (high - low)


@settings(max_examples=4, deadline=None)
@given(
    params=st.sampled_from(SHORT),
    steps=st.integers(60, 120),
    mean=st.floats(0.05, 0.3),
    noise=st.sampled_from([0.0, 0.05]),
    u=st.sampled_from([0.0, 0.02, 0.3, 0.9, 1.0]),
    seed=st.integers(0, 999),
)
@example(params=SHORT[0], steps=60, mean=0.13, noise=0.0, u=1.0, seed=0)
@example(params=FIELD, steps=60, mean=0.2, noise=0.0, u=1.0, seed=0)
@example(params=FIELD, steps=60, mean=0.2, noise=0.0, u=0.0, seed=0)
def test_short_cycles_have_a_bracket_that_is_not_negative_or_none(
    params, steps, mean, noise, u, seed
):
    """Light work from the bottom of the window to any end: the real run may miss the highest, for
    it has to ramp up, and then says nothing; it never seems to beat the lower bound."""
    power_w = params.engine.power_max_w
    noise_w = noise * power_w * np.random.default_rng(seed).standard_normal(steps)
    demand_w, soc = mean * power_w + noise_w, params.battery.soc_min + 0.1
    certificate = certify(params, demand_w, soc, reachable_end(params, demand_w, soc, u))
    slow = params.engine.ramp_w_per_s < np.inf
    assert certificate.bracket_width is not None or (slow and not certificate.ok)
    assert certificate.bracket_width is None or certificate.bracket_width >= -1e-3


def test_the_real_plant_is_driven_as_high_as_it_can_get():
    """Full power from the first step, ramp apart: what it misses is the ramp's energy at most.
    The battery takes all that 120 kW of work leave of it."""
    demand_w = np.full(60, 120e3)
    target = reachable_end(FIELD, demand_w, 0.4, 1.0)
    run = drive_plan(FIELD, solve_engine(FIELD, demand_w, 0.4, target))
    most_w = float(engine_knots_w(FIELD)[-1])
    ramp_j = most_w * FIELD.engine.power_max_w / FIELD.engine.ramp_w_per_s
    assert (target - run.soc_final) * FIELD.battery.energy_j <= ramp_j
    assert np.all(run.engine_power_w[10:] >= 0.999 * most_w)


def test_a_landing_next_to_the_end_of_what_a_step_reaches_is_found():
    """All nodes tried, or every few and then around the best: the same fuel."""
    params, demand_w = SHORT[0], np.full(59, 19.4e3)
    every = solve_engine(params, demand_w, 0.302, 0.35565).lower_bound_kg
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(engine_dp, "EVERY_NODE", 0)
        some = solve_engine(params, demand_w, 0.302, 0.35565).lower_bound_kg
    assert some == pytest.approx(every, rel=1e-6)


def test_a_ramp_too_slow_to_plan_with_is_refused_by_name():
    params = with_engine(ramp_w_per_s=1.0)
    solution = solve_engine(params, np.full(20, 40e3), 0.55, 0.55)
    with pytest.raises(ConfigError, match=r"engine.ramp_w_per_s: 1.0, allowed >= "):
        plan_policy(params, solution)


def test_no_engine_idles_where_nothing_takes_its_power():
    """A full battery and braking: the plant stops the engine, and the optimum pays the restart."""
    work_w = np.tile(np.append(np.full(12, 290e3), np.full(4, -300e3)), 5)
    params = relaxed(FIELD)
    found = solve_engine(params, work_w, 0.55, 0.55)
    policy = PlannedPolicy(params, work_w, found.plan.engine_power_w, found.plan.engine_on)
    run = drive(policy, params, work_w[None, :], 0.55, 0.55)[0]
    assert not found.plan.engine_on[work_w < 0.0].any()
    assert found.plan.starts == 5
    assert run.fuel_kg.sum() == pytest.approx(found.plan.fuel_kg.sum(), rel=1e-9)
