"""The DP policy acts on the actual state, and drives nothing but the cycle it was solved for."""

import dataclasses
from functools import cache

import numpy as np
import pytest

from tractor_ems.drive import drive
from tractor_ems.optimal.dp import solve
from tractor_ems.policies.dp import DpPolicy, solve_policy
from tractor_msgs_py.errors import PolicyError, RunAborted
from tractor_msgs_py.observation import Observation, ObservationBuilder
from tractor_msgs_py.trajectory import trajectory_hash
from tractor_msgs_py.types import DEFAULT_T0_NS, PowerDemand, RunInfo
from tractor_sim.config import load_powertrain
from tractor_sim.duty_cycle.library import load_cycle
from tractor_sim.powertrain import PlantState, StepResult, initial_state, step
from tractor_sim.readings import battery_reading, powertrain_reading

PAPER = load_powertrain("paper")
DEMAND_W = load_cycle("planter").power_demand_w[:150]
SOC_TOLERANCE = 1e-9
"""How exactly an in-process run ends at a target that it can reach."""


@cache
def solved() -> DpPolicy:
    """The policy of most tests, solved by the first."""
    return solve_policy(PAPER, DEMAND_W, 0.85, 0.845)


def run_info(t0_ns: int = DEFAULT_T0_NS) -> RunInfo:
    return RunInfo(
        run_id="run",
        cycle="planter",
        cycle_hash="",
        powertrain="paper",
        powertrain_hash="",
        t0_ns=t0_ns,
        dt_s=1.0,
        steps=1000,
        p_aux_w=0.0,
        soc_initial=0.85,
        soc_target=0.845,
    )


def observe(
    builder: ObservationBuilder,
    k: int,
    demand_w: float,
    state: PlantState,
    last: StepResult | None = None,
) -> Observation:
    """What a node sees at tick k: three samples through the builder, batch of one."""
    assert builder.run is not None
    stamp_ns = builder.run.stamp_ns(k)
    builder.add(PowerDemand(stamp_ns, demand_w))
    builder.add(battery_reading(PAPER, state, last, stamp_ns))
    observation = builder.add(powertrain_reading(PAPER, state, last, stamp_ns))
    assert observation is not None
    return observation


def first_observation(k: int = 0, demand_w: float = DEMAND_W[0], soc: float = 0.85) -> Observation:
    builder = ObservationBuilder(solved().spec)
    builder.start_run(run_info())
    return observe(builder, k, demand_w, initial_state(PAPER, soc))


@pytest.mark.parametrize("soc_target", [0.83, 0.845, 0.85, 0.855])
def test_run_ends_at_the_target(soc_target):
    policy = solve_policy(PAPER, DEMAND_W, 0.85, soc_target)
    run = drive(policy, PAPER, DEMAND_W[None, :], 0.85, soc_target)[0]
    assert run.soc_final == pytest.approx(soc_target, abs=SOC_TOLERANCE)
    assert run.shortfall_j.sum() == 0.0


def test_one_observation_at_a_time_gives_the_commands_of_the_in_process_run():
    run = drive(solved(), PAPER, DEMAND_W[None, :], 0.85, 0.845)[0]
    builder = ObservationBuilder(solved().spec)
    builder.start_run(run_info())
    state, last, memory = initial_state(PAPER, 0.85), None, solved().init(1)
    for k, demand_w in enumerate(DEMAND_W):
        observation = observe(builder, k, float(demand_w), state, last)
        command, memory = solved().act(observation, memory)
        assert command.battery_power_w[0] == run.command_battery_power_w[k]
        np.testing.assert_array_equal(command.engine_power_w[0], run.command_engine_power_w[k])
        state, last = step(PAPER, state, observation.power_demand_w, command)


def test_a_batch_drives_like_single_runs():
    demand_w = np.tile(DEMAND_W, (3, 1))
    alone = drive(solved(), PAPER, demand_w[:1], 0.85, 0.845)[0]
    hashes = {trajectory_hash(run) for run in drive(solved(), PAPER, demand_w, 0.85, 0.845)}
    assert hashes == {trajectory_hash(alone)}


def test_engine_off_is_said_and_never_inferred():
    run = drive(solved(), PAPER, DEMAND_W[None, :], 0.85, 0.845)[0]
    said_off = run.command_engine_power_w == 0.0
    assert said_off.any()
    assert not said_off.all()
    np.testing.assert_array_equal(said_off, ~run.engine_on)
    assert np.all(np.isnan(run.command_engine_power_w[~said_off]))
    assert np.all(run.engine_power_w[~said_off] > 1e3)


def test_a_disturbed_soc_is_acted_on_and_the_target_still_met():
    """The policy goes by the state it sees: half a step of energy vanishes, and is replaced."""
    state, memory = initial_state(PAPER, 0.85), solved().init(1)
    builder = ObservationBuilder(solved().spec)
    builder.start_run(run_info())
    for k, demand_w in enumerate(DEMAND_W):
        observation = observe(builder, k, float(demand_w), state)
        command, memory = solved().act(observation, memory)
        state, _ = step(PAPER, state, observation.power_demand_w, command)
        if k == 60:
            state = dataclasses.replace(state, soc=state.soc - 1e-4)
    # Where the count is lost the float32 SOC is what is left to go by.
    assert state.soc[0] == pytest.approx(0.845, abs=1e-7)


def test_state_is_not_mutated_and_decides_the_same_again():
    observation, memory = first_observation(), solved().init(1)
    first, after = solved().act(observation, memory)
    second, _ = solved().act(observation, memory)
    assert memory.t0_ns is None
    assert after.t0_ns == observation.stamp_ns
    assert first.battery_power_w[0] == second.battery_power_w[0]


def test_another_demand_stops_the_run_with_tick_and_both_demands():
    demand_w = DEMAND_W.copy()
    demand_w[7] += 1.0
    with pytest.raises(RunAborted) as error:
        drive(solved(), PAPER, demand_w[None, :], 0.85, 0.845)
    message = str(error.value)
    assert "tick 7" in message
    assert f"{demand_w[7]}" in message
    assert f"{DEMAND_W[7]}" in message
    assert error.value.exit_code == 3


@pytest.mark.parametrize("demand_w", [float("nan"), float("inf")])
def test_a_demand_that_is_no_number_is_not_the_solved_one(demand_w):
    observation = dataclasses.replace(first_observation(), power_demand_w=np.array([demand_w]))
    with pytest.raises(RunAborted, match="tick 0"):
        solved().act(observation, solved().init(1))


def test_a_longer_cycle_stops_at_the_end_of_the_solved_one():
    longer_w = np.append(DEMAND_W, DEMAND_W[-1])
    with pytest.raises(RunAborted, match=r"tick 150 .* ticks 0..149"):
        drive(solved(), PAPER, longer_w[None, :], 0.85, 0.845)


def test_a_known_epoch_places_a_policy_that_joins_late():
    policy = dataclasses.replace(solved(), t0_ns=DEFAULT_T0_NS)
    run = drive(solved(), PAPER, DEMAND_W[None, :], 0.85, 0.845)[0]
    observation = first_observation(40, DEMAND_W[40], float(run.soc[40]))
    command, _ = policy.act(observation, policy.init(1))
    assert command.battery_power_w[0] == pytest.approx(run.command_battery_power_w[40], abs=50.0)
    with pytest.raises(RunAborted, match="tick 0"):
        solved().act(observation, solved().init(1))


def test_another_initial_soc_is_refused():
    with pytest.raises(RunAborted, match=r"tick 0: SOC is 0.8.* from 0.85 to 0.845"):
        drive(solved(), PAPER, DEMAND_W[None, :], 0.80, 0.845)


def test_a_solution_for_the_whole_window_starts_anywhere():
    solution = solve(PAPER, DEMAND_W, 0.845, actions=101)
    for soc in (0.83, 0.85, 0.86):
        run = drive(DpPolicy(PAPER, solution), PAPER, DEMAND_W[None, :], soc, 0.845)[0]
        assert run.soc_final == pytest.approx(0.845, abs=1e-6)


def test_a_solution_of_another_powertrain_is_refused():
    other = dataclasses.replace(PAPER, p_aux_w=4e3)
    with pytest.raises(PolicyError, match="cannot drive paper"):
        DpPolicy(other, solved().solution)
