"""The bracket: what the real plant drives keeps its limits and is close to the lower bound."""

import dataclasses
import itertools

import numpy as np
import pytest

from tractor_ems.drive import drive
from tractor_ems.optimal.bracket import drive_plan, plan_policy
from tractor_ems.optimal.certificate import BRACKET_LIMIT, HALVING_LIMIT, ROLLOUT_LIMIT, certify
from tractor_ems.optimal.engine_dp import relaxed, solve_engine
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
        (
            with_engine(ramp_w_per_s=20e3, min_on_s=20.0, min_off_s=30.0),
            generated_w("loader", 3, 300),
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


@pytest.mark.parametrize("operation", ["loader", "baler"])
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
