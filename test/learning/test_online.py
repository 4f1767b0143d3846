"""Learning by driving: who is stored, when an update happens, what greedy means."""

from dataclasses import replace

import numpy as np
import pytest

from tractor_ems.learning.dqn_kernel import Rule
from tractor_ems.learning.mdp import ActionMapping, Mdp, make_mdp
from tractor_ems.learning.online import (
    OnlineAgent,
    Pace,
    encode_trace,
    greedy_episode,
    make_agent,
    make_encoder,
    train_episodes,
)
from tractor_ems.learning.rewards import RewardConfig, RewardKind
from tractor_msgs_py.errors import RunAborted
from tractor_sim.config import load_powertrain
from tractor_sim.duty_cycle.library import load_cycle

PACE = Pace(
    gamma=0.99,
    learning_rate=1e-3,
    steps_per_update=4,
    warm_up=100,
    target_every=50,
    target_rate=1.0,
)
RULE = Rule(double=True, huber=True, tanh=False, margin=0.0)


def process(
    reward: RewardKind = "fuel", mapping: ActionMapping = "p_eng_knots", steps: int = 200
) -> Mdp:
    params = load_powertrain("paper")
    params = replace(params, battery=replace(params.battery, soc_min=0.84))
    return make_mdp(
        params,
        load_cycle("planter").power_demand_w[:steps],
        RewardConfig(reward, start_price_kg=0.0),
        mapping=mapping,
        actions=65,
        soc_initial=0.85,
        soc_target=0.85,
    )


def agent_of(mdp: Mdp, seed: int = 0, capacity: int = 1000) -> OnlineAgent:
    return make_agent(mdp, (16,), np.random.default_rng(seed), batch=16, capacity=capacity)


def test_an_update_follows_every_so_many_steps_after_the_warm_up() -> None:
    mdp = process()
    agent = agent_of(mdp)
    train_episodes(
        agent, mdp, make_encoder(mdp, None), np.ones(3), np.random.default_rng(1), PACE, RULE
    )
    steps, updates = agent.progress
    assert steps == 600
    # 100 transitions are stored after 100 steps, whose own multiple of four is already served.
    assert updates == (600 - 100) // 4 + 1


def test_the_last_step_of_an_episode_is_not_stored() -> None:
    mdp = process()
    agent = agent_of(mdp)
    train_episodes(
        agent, mdp, make_encoder(mdp, None), np.ones(2), np.random.default_rng(1), PACE, RULE
    )
    assert agent.replay.size == 2 * 199


def test_the_replay_overwrites_its_oldest() -> None:
    mdp = process()
    agent = agent_of(mdp, capacity=300)
    train_episodes(
        agent, mdp, make_encoder(mdp, None), np.ones(2), np.random.default_rng(1), PACE, RULE
    )
    assert (agent.replay.size, agent.replay.next) == (300, 398 - 300)


def test_without_exploration_or_updates_training_earns_what_greedy_earns() -> None:
    mdp, never = process("piecewise"), PACE._replace(warm_up=10_000)
    agent, encoder = agent_of(mdp), make_encoder(mdp, 200)
    returns = train_episodes(
        agent, mdp, encoder, np.zeros(2), np.random.default_rng(1), never, RULE
    )
    assert agent.progress[1] == 0
    greedy = greedy_episode(agent, mdp, encoder)
    np.testing.assert_allclose(returns, greedy.reward.sum(), rtol=1e-6)


@pytest.mark.parametrize("mapping", ["p_batt_grid", "p_eng_knots"])
def test_every_stored_action_was_feasible(mapping: ActionMapping) -> None:
    mdp = process(mapping=mapping)
    agent = agent_of(mdp)
    train_episodes(
        agent, mdp, make_encoder(mdp, None), np.full(3, 0.5), np.random.default_rng(1), PACE, RULE
    )
    stored = {name: column[: agent.replay.size] for name, column in agent.replay.columns.items()}
    assert np.all((stored["first"] <= stored["action"]) & (stored["action"] <= stored["last"]))
    assert len(np.unique(stored["action"])) > 20


def test_the_target_net_moves_only_when_it_is_due() -> None:
    mdp = process()
    agent = agent_of(mdp)
    before = agent.target.flat.copy()
    late = PACE._replace(target_every=10_000)
    train_episodes(
        agent, mdp, make_encoder(mdp, None), np.ones(2), np.random.default_rng(1), late, RULE
    )
    np.testing.assert_array_equal(agent.target.flat, before)
    assert not np.array_equal(agent.online.flat, before)
    train_episodes(
        agent,
        mdp,
        make_encoder(mdp, None),
        np.ones(1),
        np.random.default_rng(1),
        PACE._replace(target_every=1),
        RULE,
    )
    np.testing.assert_array_equal(agent.target.flat, agent.online.flat)


def test_the_same_seed_gives_the_same_weights_and_another_does_not() -> None:
    mdp = process()

    def trained(seed: int) -> np.ndarray:
        agent = agent_of(mdp)
        train_episodes(
            agent,
            mdp,
            make_encoder(mdp, None),
            np.full(2, 0.3),
            np.random.default_rng(seed),
            PACE,
            RULE,
        )
        return agent.online.flat

    np.testing.assert_array_equal(trained(3), trained(3))
    assert not np.array_equal(trained(3), trained(4))


def test_a_network_learns_to_burn_less_than_it_did_untrained() -> None:
    mdp = process("fuel")
    agent, encoder = agent_of(mdp, capacity=20_000), make_encoder(mdp, None)
    epsilon = np.linspace(1.0, 0.1, 40)
    before = greedy_episode(agent, mdp, encoder).reward.sum()
    random = train_episodes(agent, mdp, encoder, epsilon, np.random.default_rng(1), PACE, RULE)[0]
    after = greedy_episode(agent, mdp, encoder).reward.sum()
    assert after > max(before, random)


def test_soc_bins_hide_what_lies_within_a_bin() -> None:
    mdp = process()
    soc = np.array([0.8401, 0.8402, 0.8499])
    demand_w = np.full(3, 100e3)
    continuous = encode_trace(make_encoder(mdp, None), demand_w, soc)[:, 1]
    binned = encode_trace(make_encoder(mdp, 10), demand_w, soc)[:, 1]
    assert len(set(continuous.tolist())) == 3
    assert binned[0] == binned[1] != binned[2]


def test_diverged_weights_end_the_run_with_a_reason() -> None:
    mdp = process()
    agent = agent_of(mdp)
    agent.online.flat[:] = np.nan
    with pytest.raises(RunAborted, match="diverged by update"):
        train_episodes(
            agent, mdp, make_encoder(mdp, None), np.ones(2), np.random.default_rng(1), PACE, RULE
        )
