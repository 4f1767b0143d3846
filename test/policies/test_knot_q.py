"""The sampled policy over off and knots of engine power: what is feasible, what it commands."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tractor_ems.drive import drive
from tractor_ems.policies.genset import power_max_w
from tractor_ems.policies.knot_q import OFF, STATE_INPUTS, KnotQ, Measured, feasible, knots_of
from tractor_ems.policies.knot_q_file import save_knot_q
from tractor_ems.policies.made import load_made
from tractor_ems.policies.mlp import Mlp
from tractor_ems.policies.policy_file import read_policy_file, write_policy_file
from tractor_ems.policies.q_policy import Normalisation
from tractor_msgs_py.errors import PolicyError
from tractor_msgs_py.observation import Observation, ObservationSpec
from tractor_sim.config import load_powertrain
from tractor_sim.powertrain import PlantState, PowertrainParams, power_limits

KNOTS = 33


@pytest.fixture(scope="module")
def field() -> PowertrainParams:
    return load_powertrain("field")


def seen(
    field: PowertrainParams, demand_w: float, on: bool, in_state_s: float, engine_w: float
) -> Observation:
    """One state, with the limits that the plant would publish."""
    one = np.ones(1)
    state = PlantState(0.55 * one, one.astype(bool) & on, in_state_s * one, engine_w * one)
    limits = power_limits(field, state)
    return Observation(
        stamp_ns=1,
        power_demand_w=demand_w * one,
        soc=state.soc,
        soc_target=state.soc,
        engine_on=state.engine_on,
        time_in_state_s=state.time_in_state_s,
        engine_power_w=state.engine_power_w,
        charge_limit_w=limits.charge_w,
        discharge_limit_w=limits.discharge_w,
        engine_limit_w=limits.engine_w,
        features=np.zeros((1, 0)),
    )


def linear(field: PowertrainParams, knots: int) -> Measured:
    """50 mg/kJ at the engine, and a battery that pays the same but for its losses."""
    fuel_kg = tuple((5e-8 * knots_of(field, knots)).tolist())
    return Measured(fuel_kg, (-7e-4, -5e-5, 0.0), 5e-8 * 1e5 / 7e-4, 0.01)


def constant(field: PowertrainParams, q: list[float]) -> KnotQ:
    """A policy whose Q is ``q`` everywhere."""
    inputs = 1 + STATE_INPUTS
    net = Mlp((np.zeros((len(q), inputs), np.float32),), (np.array(q, np.float32),))
    spec = ObservationSpec(dt_s=field.dt_s)
    return KnotQ(field, spec, net, Normalisation(0.0, 1e5), 2400.0, linear(field, len(q) - 1), 1.5)


def preferring(field: PowertrainParams, action: int) -> KnotQ:
    return constant(field, [float(k == action) for k in range(1 + KNOTS)])


def test_a_restart_reaches_only_the_knots_of_one_second_of_ramp(field: PowertrainParams):
    choices, _, most_w = feasible(field, seen(field, 5e4, False, 60.0, 0.0), KNOTS)
    mask = choices.mask(KNOTS)[0]
    width_w = power_max_w(field) / (KNOTS - 1)
    assert mask[OFF] and mask[1] and most_w[0] < 60e3
    assert np.flatnonzero(mask[1:]).max() * width_w <= most_w[0] + 0.5 * width_w
    assert not mask[1 + KNOTS // 2 :].any()


def test_a_ramp_down_keeps_low_knots_out_of_reach(field: PowertrainParams):
    choices, least_w, _ = feasible(field, seen(field, 1.5e5, True, 60.0, 2e5), KNOTS)
    width_w = power_max_w(field) / (KNOTS - 1)
    assert least_w[0] > 1.3e5
    assert np.flatnonzero(choices.mask(KNOTS)[0, 1:]).min() * width_w >= least_w[0] - 0.5 * width_w


def test_minimum_times_leave_one_way(field: PowertrainParams):
    just_on, _, _ = feasible(field, seen(field, 2e4, True, 2.0, 5e4), KNOTS)
    assert not just_on.mask(KNOTS)[0, OFF] and just_on.mask(KNOTS)[0, 1:].any()
    just_off, _, _ = feasible(field, seen(field, 2e4, False, 2.0, 0.0), KNOTS)
    assert just_off.mask(KNOTS)[0].tolist() == [True] + [False] * KNOTS


def test_a_feasible_off_that_is_worth_most_is_commanded_as_off(field: PowertrainParams):
    policy = preferring(field, OFF)
    command, _ = policy.act(seen(field, 5e4, True, 60.0, 5e4), policy.init(1))
    assert command.engine_power_w[0] == 0.0
    command, _ = policy.act(seen(field, 5e4, True, 2.0, 5e4), policy.init(1))
    assert np.isnan(command.engine_power_w[0]) and command.battery_power_w[0] < 5e4


def test_an_infeasible_knot_is_not_chosen_however_much_it_seems_worth(field: PowertrainParams):
    policy = preferring(field, KNOTS)  # full power
    command, _ = policy.act(seen(field, 5e4, True, 60.0, 5e4), policy.init(1))
    engine_w = 5e4 - command.battery_power_w[0]
    _, least_w, most_w = feasible(field, seen(field, 5e4, True, 60.0, 5e4), KNOTS)
    assert least_w[0] <= engine_w <= most_w[0] < power_max_w(field)


def test_an_engine_that_is_off_starts_only_for_more_than_a_start_costs(field: PowertrainParams):
    for gain, starts in ((1.4, False), (1.6, True)):
        policy = constant(field, [0.0] + [gain] * KNOTS)
        command, _ = policy.act(seen(field, 5e4, False, 60.0, 0.0), policy.init(1))
        assert (command.engine_power_w[0] != 0.0) == starts


def test_running_power_is_the_knot_of_least_fuel_at_what_soc_is_worth(field: PowertrainParams):
    policy = preferring(field, 1)
    # Fuel is linear, so the loss of the battery alone decides: demand is followed.
    command, _ = policy.act(seen(field, 5.1e4, True, 60.0, 5e4), policy.init(1))
    assert abs(command.battery_power_w[0]) < power_max_w(field) / (KNOTS - 1)
    dear = list(policy.measured.fuel_kg)
    knot = round(5.1e4 / power_max_w(field) * (KNOTS - 1))
    dear[knot] = 1.0
    other = replace(policy, measured=replace(policy.measured, fuel_kg=tuple(dear)))
    again, _ = other.act(seen(field, 5.1e4, True, 60.0, 5e4), other.init(1))
    assert again.battery_power_w[0] != command.battery_power_w[0]


@pytest.mark.parametrize("action", [OFF, 1, KNOTS // 2, KNOTS])
def test_whatever_it_prefers_no_limit_is_broken(field: PowertrainParams, action: int):
    demand_w = np.abs(1e5 * np.sin(np.arange(120) / 9.0))[None, :]
    run = drive(preferring(field, action), field, demand_w, 0.55, 0.55)[0]
    assert run.shortfall_j.sum() == 0.0
    # Crank power follows the ramp; at the bus a step is less.
    assert np.diff(run.engine_power_w[run.engine_on]).max(initial=0.0) <= 60e3
    assert field.battery.soc_min <= run.soc.min() and run.soc.max() <= field.battery.soc_max


def test_a_file_gives_back_the_policy_and_a_damaged_one_is_refused(
    field: PowertrainParams, tmp_path: Path
):
    policy, path = preferring(field, 3), tmp_path / "p.safetensors"
    save_knot_q(path, policy)
    loaded = load_made(path)
    assert loaded.name == "ddqn_sampled"
    observation, state = seen(field, 5e4, True, 60.0, 5e4), policy.init(1)
    wanted, found = (p.act(observation, state)[0] for p in (policy, loaded))
    assert found.battery_power_w.tobytes() == wanted.battery_power_w.tobytes()
    tensors, data = read_policy_file(path)
    for broken in (
        {**data, "horizon_s": 0.0},
        {**data, "measured": {**data["measured"], "fuel_kg": [1.0]}},
        {**data, "network": {**data["network"], "layers": 2}},
        {**data, "network": {**data["network"], "activation": "sine"}},
    ):
        write_policy_file(path, tensors, broken)
        with pytest.raises(PolicyError):
            load_made(path)
    with pytest.raises(PolicyError, match="needs 4"):
        replace(policy, net=Mlp((np.zeros((34, 9), np.float32),), (np.zeros(34, np.float32),)))
