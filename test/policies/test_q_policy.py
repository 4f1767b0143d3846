"""The learned policy at run time: light imports, feasible answers, explicit engine off."""

import itertools
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from tractor_ems.drive import drive
from tractor_ems.learning.rewards import RewardConfig, resolve
from tractor_ems.policies.made import check_powertrain
from tractor_ems.policies.mlp import Mlp
from tractor_ems.policies.q_policy import Normalisation, QPolicy, own_limits
from tractor_msgs_py.errors import PolicyError
from tractor_msgs_py.observation import DemandFilter, Observation, ObservationSpec
from tractor_sim.config import load_powertrain
from tractor_sim.duty_cycle.library import load_cycle
from tractor_sim.powertrain import feasible_battery_power_w
from tractor_sim.powertrain_json import powertrain_hash

PAPER = load_powertrain("paper")
SPEC = ObservationSpec(
    dt_s=1.0,
    filters=(DemandFilter("running_mean", 120.0, 143e3), DemandFilter("low_pass", 8.0)),
)
KINDS = ("ddqn_counterfactual", "ddqn_sampled")


def make_policy(kind: str, seed: int = 0, actions: int = 1600) -> QPolicy:
    """An untrained policy: every output is as good as any other for what is asked here."""
    rng = np.random.default_rng(seed)
    sizes = (4, 16, 2) if kind == "ddqn_counterfactual" else (5, 16, actions)
    weights = tuple(
        rng.normal(size=(b, a)).astype(np.float32) for a, b in itertools.pairwise(sizes)
    )
    biases = tuple(rng.normal(size=b).astype(np.float32) for b in sizes[1:])
    return QPolicy(
        name=kind,  # type: ignore[arg-type]
        spec=SPEC,
        params=PAPER,
        reward=resolve(RewardConfig(), PAPER),
        net=Mlp(weights, biases, "tanh"),
        scaling=Normalisation(143e3, 40e3),
        gamma=0.98,
        actions=actions,
    )


def observe(demand_w: list[float], soc: float = 0.8, **limits: float) -> Observation:
    batch = len(demand_w)
    return Observation(
        stamp_ns=1,
        power_demand_w=np.array(demand_w),
        soc=np.full(batch, np.float32(soc), dtype=np.float64),
        soc_target=np.full(batch, 0.836),
        engine_on=np.zeros(batch, bool),
        time_in_state_s=np.full(batch, 100.0),
        engine_power_w=np.zeros(batch),
        charge_limit_w=np.full(batch, limits.get("charge", 250e3)),
        discharge_limit_w=np.full(batch, limits.get("discharge", 250e3)),
        engine_limit_w=np.full(batch, limits.get("engine", 275e3)),
        features=np.tile([140e3, 150e3], (batch, 1)),
    )


HEAVY = ("torch", "numba", "pydantic", "yaml", "rosbags", "mcap", "rclpy", "matplotlib", "typer")


def test_importing_the_policy_loads_no_training_or_bag_library():
    code = (
        "import sys, tractor_ems.policies.q_policy; "
        f"print([m for m in {HEAVY!r} if m in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], text=True, capture_output=True, timeout=120
    )
    assert done.stdout.strip() == "[]", done.stdout + done.stderr


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(4))
def test_commands_are_feasible_and_say_engine_off_explicitly(kind: str, seed: int):
    policy = make_policy(kind, seed)
    demand = [5e3, 60e3, 143e3, 240e3, 270e3, 0.0, -50e3]
    observation = observe(demand, soc=0.7002 if seed % 2 else 0.8)
    command, state = policy.act(observation, policy.init(len(demand)))
    assert state is None
    lb, ub = feasible_battery_power_w(own_limits(PAPER, observation), observation.power_demand_w)
    assert np.all(command.battery_power_w >= lb) and np.all(command.battery_power_w <= ub)
    off = command.battery_power_w >= observation.power_demand_w
    assert np.array_equal(command.engine_power_w == 0.0, off)
    assert np.all(np.isnan(command.engine_power_w[~off]))


@pytest.mark.parametrize("kind", KINDS)
def test_published_limits_cut_the_policys_own(kind: str):
    demand = [100e3, 150e3, 200e3]
    limits = {"charge": 3e3, "discharge": 20e3, "engine": 190e3}
    for seed in range(6):
        command, _ = make_policy(kind, seed).act(observe(demand, **limits), None)
        assert np.all(command.battery_power_w >= np.maximum(-3e3, np.array(demand) - 190e3))
        assert np.all(command.battery_power_w <= 20e3)


def test_the_greedy_choice_never_takes_an_infeasible_action():
    """The network adores the two ends of the grid, which demand 30 kW makes infeasible."""
    policy = make_policy("ddqn_sampled")
    bias = np.zeros(1600, np.float32)
    bias[[0, 1599]], bias[850] = 1e6, 1e3
    net = Mlp((policy.net.weights[0], 0 * policy.net.weights[1]), (policy.net.biases[0], bias))
    command, _ = replace(policy, net=net).act(observe([30e3], charge=240e3), None)
    assert command.battery_power_w[0] == policy.grid_w[850]


@pytest.mark.parametrize("kind", KINDS)
def test_a_run_is_repeatable_to_the_bit(kind: str):
    policy = make_policy(kind)
    demand = load_cycle("planter_30").power_demand_w[None, :200]
    first, second = (drive(policy, PAPER, demand, 0.85, 0.836)[0] for _ in range(2))
    assert np.array_equal(first.battery_power_w, second.battery_power_w)
    assert first.shortfall_j.sum() == 0.0


@pytest.mark.parametrize("kind", KINDS)
def test_the_target_comes_with_the_run(kind: str):
    """The network sees SOC - target: shifting both leaves the answer as it is."""
    policy = make_policy(kind)
    here = observe([150e3], soc=0.75)
    there = replace(here, soc=here.soc + 0.0625, soc_target=here.soc_target + 0.0625)
    a, b = policy.act(here, None)[0], policy.act(there, None)[0]
    assert a.battery_power_w == pytest.approx(b.battery_power_w, abs=400.0)


def test_inputs_and_outputs_must_fit_the_observation():
    policy = make_policy("ddqn_counterfactual")
    with pytest.raises(PolicyError, match="network maps 4 inputs to 2 outputs"):
        replace(policy, spec=ObservationSpec(dt_s=1.0))
    with pytest.raises(PolicyError, match="needs 5 to 1600"):
        replace(policy, name="ddqn_sampled")


def test_another_powertrain_is_refused_by_name():
    policy = make_policy("ddqn_sampled")
    check_powertrain(policy, powertrain_hash(PAPER))
    other = replace(PAPER, battery=replace(PAPER.battery, soc_min=0.6))
    with pytest.raises(PolicyError, match="was made for powertrain paper"):
        check_powertrain(policy, powertrain_hash(other))
