"""Tabular Q and double Q: the agents on the tractor, against production and brute force."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tractor_ems.drive import drive
from tractor_ems.learning.checkpoint import load_checkpoint, save_checkpoint
from tractor_ems.learning.mdp import Mdp, bounds_w, feasible_actions, make_mdp
from tractor_ems.learning.rewards import RewardConfig, RewardKind
from tractor_ems.learning.tabular import (
    TabularAgent,
    greedy_episode,
    make_agent,
    pairs_visited,
    restore_state,
    sparse_state,
    table_study,
    train_episodes,
)
from tractor_ems.policies.action_grid import feasible_range
from tractor_ems.policies.protocol import ANY_RUN, limits_of
from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.observation import Observation, ObservationSpec
from tractor_sim.config import load_powertrain
from tractor_sim.duty_cycle.library import load_cycle
from tractor_sim.powertrain import Command, feasible_battery_power_w, project

PAPER = load_powertrain("paper")
DEMAND_W = load_cycle("planter").power_demand_w[:120]
GAMMA = 0.9

SLOW = pytest.mark.slow
DOUBLE = pytest.mark.parametrize("double", [False, True], ids=["q", "double_q"])
INTERPOLATE = pytest.mark.parametrize("interpolate", [False, True], ids=["binned", "interpolated"])


def process(
    demand_w=DEMAND_W, *, actions: int = 41, soc: float = 0.85, kind: RewardKind = "piecewise"
) -> Mdp:
    return make_mdp(
        PAPER,
        demand_w,
        RewardConfig(kind=kind, start_price_kg=0.0),
        mapping="p_batt_grid",
        actions=actions,
        soc_initial=soc,
        soc_target=0.836,
    )


def trained(
    mdp: Mdp, episodes: int, seed: int = 1, *, epsilon: float = 0.5, **shape: Any
) -> TabularAgent:
    agent = make_agent(mdp, **{"soc_bins": 50, "demand_bins": 30, "double": False, **shape})
    rng = np.random.default_rng(seed)
    train_episodes(agent, mdp, np.full(episodes, epsilon), rng, gamma=GAMMA)
    return agent


def visited_pairs(agent: TabularAgent) -> np.ndarray:
    """Shape (soc_bins, demand_bins, actions), bool."""
    shape = (agent.grid.soc_bins, agent.grid.demand_bins, agent.tables.shape[2])
    return np.unpackbits(agent.visited, bitorder="little", count=np.prod(shape)).reshape(shape) > 0


def demand_bins_of(agent: TabularAgent, demand_w: np.ndarray) -> np.ndarray:
    low, high, bins = DEMAND_W.min(), DEMAND_W.max(), agent.grid.demand_bins
    return np.minimum(((demand_w - low) / (high - low) * bins).astype(int), bins - 1)


def assert_equal_agents(one: TabularAgent, other: TabularAgent) -> None:
    assert one.tables.tobytes() == other.tables.tobytes()
    assert one.visited.tobytes() == other.visited.tobytes()
    assert one.state_visits.tobytes() == other.state_visits.tobytes()


@pytest.mark.slow
def test_soc_leaves_its_bin_although_no_step_moves_it_by_a_tenth_of_one():
    """A table that snapped SOC to its bin centres would stay where it started."""
    demand_w = np.full(400, 200e3)  # more than a battery at 0.85 gives for long
    mdp = process(demand_w, actions=1600, kind="fuel")
    agent = make_agent(mdp, double=False, soc_bins=50, demand_bins=1)
    agent.tables[:] = np.arange(1600)  # the most discharge is the best
    soc = greedy_episode(agent, mdp).soc
    moved_bins = np.diff(soc) / agent.grid.soc_step
    assert 0.0 < np.max(np.abs(moved_bins)) < 0.1
    assert soc[0] - soc[-1] > 20 * agent.grid.soc_step


@DOUBLE
@INTERPOLATE
@pytest.mark.parametrize("soc", [0.7005, *(pytest.param(x, marks=SLOW) for x in (0.85, 0.8995))])
def test_infeasible_actions_are_never_visited(double: bool, interpolate: bool, soc: float):
    """At both ends of the SOC window, and between. Allowed is what any state within reach of the
    bin allows, by brute force over SOC and the demands of the cycle."""
    mdp = process(soc=soc)
    agent = trained(mdp, 200, epsilon=0.9, double=double, interpolate=interpolate)
    visited, allowed = visited_pairs(agent), np.zeros_like(visited_pairs(agent))
    columns = demand_bins_of(agent, DEMAND_W)
    reach = agent.grid.soc_step * (1.0 if interpolate else 0.5)
    for i in range(agent.grid.soc_bins):
        centre = 0.70 + (i + 0.5) * agent.grid.soc_step
        ends = np.clip([centre - reach, centre + reach], 0.70, 0.90)
        for near in np.linspace(*ends, 9):
            for demand_w, j in zip(DEMAND_W, columns, strict=True):
                lb, ub = bounds_w(mdp, demand_w, near)
                first, last = feasible_actions(mdp, demand_w, lb, ub)
                allowed[i, j, first : last + 1] = True
    assert visited.any()
    assert not np.any(visited & ~allowed)
    assert np.all(agent.tables.reshape(-1, *visited.shape)[:, ~visited] == 0.0)


@DOUBLE
def test_the_last_step_is_a_truncation_and_is_not_learnt_from(double: bool):
    mdp = process(DEMAND_W[:1])
    one = trained(mdp, 5, double=double)
    assert one.state_visits.sum() == 5
    assert pairs_visited(one) == 0
    assert not one.tables.any()
    two = trained(process(DEMAND_W[:2]), 1, double=double)
    assert two.state_visits.sum() == 2
    assert pairs_visited(two) == 1


def test_the_first_update_by_hand():
    """All is 0, so the target is the reward alone and one tenth of it is learnt."""
    mdp = process(DEMAND_W[:2], kind="fuel")
    agent = make_agent(mdp, double=False)
    total = train_episodes(agent, mdp, np.zeros(1), np.random.default_rng(3), gamma=1.0)
    (action,) = np.flatnonzero(agent.tables.any(axis=(0, 1)))
    lb, ub = bounds_w(mdp, DEMAND_W[0], 0.85)
    asked_w = np.clip(mdp.action_power_w[action], lb, ub)
    fuel_kg = drive(Replay(np.array([asked_w, 0.0])), PAPER, DEMAND_W[None, :2], 0.85, 0.85)[
        0
    ].fuel_kg
    assert agent.tables.min() == pytest.approx(-0.1 * fuel_kg[0] / 0.010, rel=1e-6)
    assert total[0] < -fuel_kg[0] / 0.010  # the second step counts in the return


def test_the_train_return_of_a_greedy_episode_is_the_sum_of_its_rewards():
    """Learning with step size 1e-12 changes nothing, so training drives the greedy episode."""
    mdp = process()
    agent = trained(mdp, 50)
    agent.tables[:] = np.random.default_rng(2).normal(size=agent.tables.shape)
    expected = greedy_episode(agent, mdp).reward.sum()
    rng = np.random.default_rng(0)
    got = train_episodes(agent, mdp, np.zeros(2), rng, gamma=0.0, alpha=1e-12)
    np.testing.assert_allclose(got, expected, rtol=1e-12)


@DOUBLE
@INTERPOLATE
def test_the_same_seed_gives_the_same_bytes_and_another_does_not(double: bool, interpolate: bool):
    mdp = process()
    one, same, other = (
        trained(mdp, 30, seed, double=double, interpolate=interpolate) for seed in (1, 1, 2)
    )
    assert_equal_agents(one, same)
    assert one.tables.tobytes() != other.tables.tobytes()


@DOUBLE
@INTERPOLATE
def test_a_resumed_run_ends_with_the_bytes_of_an_unbroken_one(
    tmp_path: Path, double: bool, interpolate: bool
):
    mdp, shape = process(), {"double": double, "interpolate": interpolate}
    epsilon = np.linspace(1.0, 0.0, 40)
    unbroken, rng = make_agent(mdp, **shape), np.random.default_rng(9)
    whole = train_episodes(unbroken, mdp, epsilon, rng, gamma=GAMMA)

    first, rng = make_agent(mdp, **shape), np.random.default_rng(9)
    head = train_episodes(first, mdp, epsilon[:20], rng, gamma=GAMMA)
    path, state = tmp_path / "run.checkpoint", {"rng": rng.bit_generator.state}
    save_checkpoint(path, sparse_state(first), state, {})

    tensors, loaded = load_checkpoint(path, {})
    used = trained(mdp, 3, 5, demand_bins=766, **shape)  # what was there must not shine through
    for second in (make_agent(mdp, **shape), used):
        rng = np.random.default_rng()
        rng.bit_generator.state = loaded["rng"]
        restore_state(second, tensors)
        assert_equal_agents(first, second)
        tail = train_episodes(second, mdp, epsilon[20:], rng, gamma=GAMMA)
        assert_equal_agents(unbroken, second)
        np.testing.assert_array_equal(np.concatenate([head, tail]), whole)


def test_a_saved_state_holds_only_what_was_updated():
    agent = trained(process(), 3, demand_bins=766, double=True)
    state = sparse_state(agent)
    assert state["values"].shape == (2, pairs_visited(agent))
    assert pairs_visited(agent) <= 3 * (len(DEMAND_W) - 1)


@dataclass(frozen=True)
class Replay:
    """Asks for given battery powers, one per step."""

    asked_w: np.ndarray
    name: str = "replay"
    spec: ObservationSpec = ANY_RUN

    def init(self, batch: int) -> int:
        return 0

    def act(self, observation: Observation, state: int) -> tuple[Command, int]:
        return Command(self.asked_w[state : state + 1], np.array([np.nan])), state + 1


@dataclass(frozen=True)
class TablePolicy:
    """Best entry of a table in plain numpy, with the production limits and action range."""

    agent: TabularAgent
    grid_w: np.ndarray
    name: str = "table"
    spec: ObservationSpec = ANY_RUN

    def init(self, batch: int) -> None:
        return None

    def act(self, observation: Observation, state: None) -> tuple[Command, None]:
        agent, demand_w = self.agent, observation.power_demand_w
        lb, ub = feasible_battery_power_w(limits_of(observation), demand_w)
        (first,), (last,) = feasible_range(self.grid_w, lb, ub)
        q = agent.tables.sum(axis=0).reshape(50, agent.grid.demand_bins, -1)
        column = q[:, demand_bins_of(agent, demand_w)[0]]
        x = (observation.soc[0] - 0.70) / 0.004
        row = column[int(x)]
        if agent.grid.interpolate:
            x = np.clip(x - 0.5, 0.0, 49.0)
            low = min(int(x), 48)
            row = column[low] * (1.0 - (x - low)) + column[low + 1] * (x - low)
        action = first + int(np.argmax(row[first : last + 1]))
        return Command(project(self.grid_w[[action]], lb, ub), np.array([np.nan])), None


@DOUBLE
@INTERPOLATE
@pytest.mark.parametrize("soc", [0.7005, 0.85])
def test_a_greedy_episode_is_what_production_drives(double: bool, interpolate: bool, soc: float):
    """Tables of noise, so that no two actions tie."""
    mdp = process(actions=1600, soc=soc)
    agent = make_agent(mdp, double=double, demand_bins=20, interpolate=interpolate)
    agent.tables[:] = np.random.default_rng(4).normal(size=agent.tables.shape)
    got = greedy_episode(agent, mdp)
    policy = TablePolicy(agent, mdp.action_power_w)
    run = drive(policy, PAPER, DEMAND_W[None, :], soc, 0.836)[0]
    np.testing.assert_allclose(got.battery_power_w, run.battery_power_w, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(got.engine_power_w, run.engine_power_w, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(got.fuel_kg, run.fuel_kg, rtol=1e-9)
    np.testing.assert_allclose(got.soc, [*run.soc, run.soc_final], rtol=1e-12)


def test_greedy_episodes_are_repeatable_and_do_not_learn():
    mdp = process()
    agent = trained(mdp, 2)
    before = agent.tables.copy()
    one, two = greedy_episode(agent, mdp), greedy_episode(agent, mdp)
    np.testing.assert_array_equal(one.battery_power_w, two.battery_power_w)
    np.testing.assert_array_equal(agent.tables, before)


@pytest.mark.parametrize(
    ("interpolate", "double"),
    [
        pytest.param(False, False, id="binned-q"),
        pytest.param(True, True, id="interpolated-double_q"),
        pytest.param(False, True, id="binned-double_q", marks=SLOW),
        pytest.param(True, False, id="interpolated-q", marks=SLOW),
    ],
)
def test_the_table_study_equals_brute_force(interpolate: bool, double: bool):
    mdp = process(kind="fuel")
    agent = trained(mdp, 20, double=double, interpolate=interpolate)
    study = table_study(agent, mdp, np.random.default_rng(0))
    q, reward = [], []
    for i, j, action in np.argwhere(visited_pairs(agent)):
        demand_w = DEMAND_W.min() + (j + 0.5) / 30 * (DEMAND_W.max() - DEMAND_W.min())
        policy, soc = Replay(mdp.action_power_w[[action]]), 0.70 + (i + 0.5) * 0.004
        reward.append(-drive(policy, PAPER, np.array([[demand_w]]), soc, soc)[0].fuel_kg[0] / 0.01)
        q.append(agent.tables[:, i * 30 + j, action].mean(dtype=np.float64))
    assert study.pairs == 50 * 30 * 41
    assert study.pairs_visited == len(q) > 500
    assert study.pearson == pytest.approx(np.corrcoef(q, reward)[0, 1], rel=1e-6)
    np.testing.assert_allclose(study.sample_q, q, rtol=1e-9)  # fewer than 20,000: all of them
    np.testing.assert_allclose(study.sample_reward, reward, rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(study.state_visits, agent.state_visits)
    assert study.state_visits.sum() == 20 * len(DEMAND_W)
    assert study.bytes == agent.tables.nbytes + agent.visited.nbytes + agent.state_visits.nbytes


def test_a_large_sample_is_20000_different_pairs_of_the_visited():
    mdp = process(actions=1600, kind="equivalent_fuel")
    agent = trained(mdp, 1500, epsilon=1.0)
    study = table_study(agent, mdp, np.random.default_rng(0))
    other = table_study(agent, mdp, np.random.default_rng(1))
    assert study.pairs_visited > 30_000
    assert len(study.sample_q) == len(study.sample_reward) == 20_000
    assert study.pearson == other.pearson
    assert not np.array_equal(study.sample_q, other.sample_q)
    sampled = np.corrcoef(study.sample_q, study.sample_reward)[0, 1]
    assert sampled == pytest.approx(study.pearson, abs=0.03)


def test_without_visits_there_is_no_correlation():
    mdp = process()
    agent = make_agent(mdp, double=True, demand_bins=5)
    study = table_study(agent, mdp, np.random.default_rng(0))
    assert study.pearson is None
    assert study.pairs_visited == len(study.sample_q) == 0


@pytest.mark.parametrize("mapping", ["p_batt_grid", "p_eng_knots"])
def test_feasible_pairs_are_those_that_some_state_of_the_bin_allows(mapping):
    """By brute force over 17 x 17 states of every bin, its corners among them."""
    mdp = make_mdp(
        PAPER,
        np.array([-40e3, 560e3]),
        RewardConfig(kind="fuel"),
        mapping=mapping,
        actions=23,
        soc_initial=0.85,
        soc_target=0.85,
    )
    agent = make_agent(mdp, double=False, soc_bins=300, demand_bins=3)
    count = 0
    for i in (0, 1, 150, 298, 299):  # the rest is like the middle
        for j in range(3):
            allowed = np.zeros(23, dtype=bool)
            socs = np.minimum(0.70 + agent.grid.soc_step * (i + np.linspace(0, 1, 17)), 0.90)
            for soc in socs:
                for demand_w in -40e3 + 200e3 * (j + np.linspace(0, 1, 17)):
                    first, last = feasible_actions(mdp, demand_w, *bounds_w(mdp, demand_w, soc))
                    allowed[first : last + 1] = True
            count += int(allowed.sum()) * (296 if i == 150 else 1)
    assert table_study(agent, mdp, np.random.default_rng(0)).pairs_feasible == count


def test_one_demand_is_one_bin():
    mdp = process(np.full(20, 120e3))
    agent = trained(mdp, 3, demand_bins=4)
    assert agent.state_visits[:, 0].sum() == 60
    assert agent.state_visits[:, 1:].sum() == 0


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"epsilon": np.array([0.5, 1.5])}, "epsilon"),
        ({"epsilon": np.array([np.nan])}, "epsilon"),
        ({"epsilon": np.ones((2, 2))}, "epsilon"),
        ({"gamma": 1.01}, "gamma"),
        ({"gamma": float("nan")}, "gamma"),
        ({"alpha": 0.0}, "alpha"),
        ({"alpha": float("nan")}, "alpha"),
        ({"mdp": process(actions=40)}, "40"),
        ({"mdp": process(DEMAND_W[:60] * 1.1)}, "another"),
    ],
)
def test_bad_input_is_refused_before_anything_is_learnt(change: dict[str, Any], match: str):
    mdp = process()
    agent = make_agent(mdp, double=False, demand_bins=5)
    use = {"mdp": mdp, "epsilon": np.ones(1), "gamma": 0.9, "alpha": 0.1, **change}
    with pytest.raises(ConfigError, match=match):
        train_episodes(agent, rng=np.random.default_rng(0), **use)
    assert not agent.tables.any()


def test_no_bins_are_refused():
    with pytest.raises(ConfigError, match="demand_bins: 0"):
        make_agent(process(), double=False, demand_bins=0)


@pytest.mark.parametrize("wrong", ["double", "soc_bins", "missing", "cut"])
def test_a_state_of_another_table_is_refused(wrong: str):
    mdp = process()
    state = sparse_state(trained(mdp, 2))
    shape = {"double": False, "soc_bins": 50, "demand_bins": 30}
    if wrong == "missing":
        del state["visited"]
    elif wrong == "cut":
        state["values"] = state["values"][:, :-1]
    else:
        shape[wrong] = {"double": True, "soc_bins": 49}[wrong]
    agent = make_agent(mdp, **shape)
    with pytest.raises(ConfigError, match="checkpoint tensor"):
        restore_state(agent, state)
    assert pairs_visited(agent) == 0
