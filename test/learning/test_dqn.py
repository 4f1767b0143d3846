"""DQN and double DQN: the update against things that are known by hand or by value iteration."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tractor_ems.learning.config import SampledConfig
from tractor_ems.learning.dqn import SampledLearner, td_target, td_update
from tractor_ems.learning.networks import Net, copy_towards, to_numpy
from tractor_ems.learning.replay import Replay, Transitions
from tractor_ems.policies.mlp import forward

MODES = pytest.mark.parametrize("double", [True, False], ids=["double", "single"])


def transitions(rows: list[tuple[int, int, float, float, int, int, int]], states: int):
    """(state, action, reward, discount, next state, first, last) with one-hot inputs."""
    state, action, reward, discount, following, first, last = zip(*rows, strict=True)
    eye = np.eye(states, dtype=np.float32)
    return Transitions(
        inputs=eye[list(state)],
        action=np.array(action, dtype=np.int64),
        reward=np.array(reward, dtype=np.float32),
        discount=np.array(discount, dtype=np.float32),
        next_inputs=eye[list(following)],
        next_first=np.array(first, dtype=np.int16),
        next_last=np.array(last, dtype=np.int16),
    )


def table_net(q: list[list[float]]) -> Net:
    """A net without hidden layer whose output for one-hot state s is q[s]."""
    net = Net((len(q), len(q[0])), "relu", np.random.default_rng(0))
    with torch.no_grad():
        net.weights[0].copy_(torch.tensor(q).T)
        net.biases[0].zero_()
    return net


def test_double_target_by_hand_on_two_actions():
    """Online prefers action 1, target values it 3 although it values action 0 at 7."""
    online, target = table_net([[1.0, 2.0]]), table_net([[7.0, 3.0]])
    batch = transitions([(0, 0, 0.5, 0.9, 0, 0, 1)], 1)
    assert td_target(online, target, batch, double=True).item() == pytest.approx(0.5 + 0.9 * 3.0)
    assert td_target(online, target, batch, double=False).item() == pytest.approx(0.5 + 0.9 * 7.0)


@MODES
def test_target_never_bootstraps_from_an_infeasible_action(double: bool):
    """The best feasible action is worth 2, an infeasible one 100, in both nets."""
    net = table_net([[100.0, 1.0, 2.0, 100.0]])
    batch = transitions([(0, 1, 0.0, 1.0, 0, 1, 2)], 1)
    assert td_target(net, net, batch, double=double).item() == 2.0


@MODES
def test_a_terminal_step_has_no_bootstrap(double: bool):
    net = table_net([[5.0, 6.0]])
    batch = transitions([(0, 0, -1.5, 0.0, 0, 0, 1)], 1)
    assert td_target(net, net, batch, double=double).item() == -1.5


STATES, ACTIONS, GAMMA = 6, 4, 0.8


def random_mdp(seed: int):
    """Deterministic, with a feasible range per state; state 0 is a myopic trap: its action 1
    pays 1 at once and leads to a poor state, action 2 pays nothing and leads to a rich one."""
    rng = np.random.default_rng(seed)
    reward = rng.uniform(-1.0, 1.0, (STATES, ACTIONS))
    following = rng.integers(1, STATES, (STATES, ACTIONS))
    first, last = rng.integers(0, 2, STATES), rng.integers(2, ACTIONS, STATES)
    first[0], last[0] = 1, 2
    reward[0, 1:3], following[0, 1:3] = (1.0, 0.0), (1, 2)
    reward[1], reward[2] = -1.0, 3.0
    following[1], following[2] = 1, 2
    return reward, following, first, last


def value_iteration(mdp) -> np.ndarray:
    reward, following, first, last = mdp
    action = np.arange(ACTIONS)
    feasible = (action >= first[:, None]) & (action <= last[:, None])
    q = np.zeros((STATES, ACTIONS))
    for _ in range(300):
        best = np.where(feasible, q, -np.inf).max(axis=1)
        q = reward + GAMMA * best[following]
    return np.where(feasible, q, np.nan)


@MODES
def test_learner_reaches_q_star_of_a_small_mdp(double: bool):
    mdp = random_mdp(3)
    reward, following, first, last = mdp
    rows = [
        (s, a, reward[s, a], GAMMA, n := int(following[s, a]), int(first[n]), int(last[n]))
        for s in range(STATES)
        for a in range(first[s], last[s] + 1)
    ]
    replay = Replay(100, STATES)
    replay.add(transitions(rows, STATES))
    config = SampledConfig(
        updates=1500, batch=32, learning_rate=5e-3, target_rate=0.1, hidden=(32,), double=double
    )
    learner = SampledLearner(
        STATES, ACTIONS, config, replay, np.random.default_rng(0), np.random.default_rng(1)
    )
    for _ in range(config.updates):
        learner.update()
    learned = forward(learner.network(), np.eye(STATES, dtype=np.float32))
    q_star = value_iteration(mdp)
    known = np.isfinite(q_star)
    assert np.abs(learned - q_star)[known].max() < 0.05
    assert q_star[0, 2] > q_star[0, 1]
    assert learned[0, 2] > learned[0, 1], "fell into the myopic trap"


@MODES
def test_updates_equal_a_plain_reference(double: bool):
    """Loops and float64 against gathered rows and float32, to 1e-6 after three updates."""
    rng = np.random.default_rng(5)
    online = Net((3, 8, 8, 5), "relu", rng)
    target = Net((3, 8, 8, 5), "relu", rng)
    batch = Transitions(
        inputs=rng.normal(size=(16, 3)).astype(np.float32),
        action=rng.integers(0, 5, 16),
        reward=(3 * rng.normal(size=16)).astype(np.float32),
        discount=np.full(16, 0.9, np.float32),
        next_inputs=rng.normal(size=(16, 3)).astype(np.float32),
        next_first=rng.integers(0, 2, 16).astype(np.int16),
        next_last=rng.integers(2, 5, 16).astype(np.int16),
    )
    optimiser = torch.optim.SGD(online.parameters(), lr=0.05)
    w = [p.detach().numpy().astype(np.float64) for p in online.weights]
    b = [p.detach().numpy().astype(np.float64) for p in online.biases]
    frozen = (
        [p.detach().numpy().astype(np.float64) for p in target.weights],
        [p.detach().numpy().astype(np.float64) for p in target.biases],
    )
    for _ in range(3):
        td_update(online, target, optimiser, batch, double=double)
        w, b = reference_update(w, b, *frozen, batch, double, 0.05)
    for got, expected in zip(to_numpy(online).weights, w, strict=True):
        assert np.abs(got - expected).max() < 1e-6
    for got, expected in zip(to_numpy(online).biases, b, strict=True):
        assert np.abs(got - expected).max() < 1e-6


def reference_update(w, b, w_target, b_target, batch, double, rate):
    """One plain SGD step of (double) DQN with a Huber loss, one sample at a time."""

    def layers(weights, biases, x):
        hidden = [x]
        for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
            hidden.append(np.maximum(weight @ hidden[-1] + bias, 0.0))
        return hidden, weights[-1] @ hidden[-1] + biases[-1]

    grad_w, grad_b = [np.zeros_like(x) for x in w], [np.zeros_like(x) for x in b]
    count = len(batch)
    for i in range(count):
        _, q_next_target = layers(w_target, b_target, batch.next_inputs[i].astype(np.float64))
        chooser = q_next_target
        if double:
            _, chooser = layers(w, b, batch.next_inputs[i].astype(np.float64))
        feasible = range(batch.next_first[i], batch.next_last[i] + 1)
        best = max(feasible, key=lambda a: chooser[a])
        y = batch.reward[i] + batch.discount[i] * q_next_target[best]
        hidden, q = layers(w, b, batch.inputs[i].astype(np.float64))
        delta = np.zeros(len(q))
        delta[batch.action[i]] = np.clip(q[batch.action[i]] - y, -1.0, 1.0) / count
        for number in reversed(range(len(w))):
            grad_w[number] += np.outer(delta, hidden[number])
            grad_b[number] += delta
            delta = (w[number].T @ delta) * (hidden[number] > 0.0)
    return (
        [x - rate * g for x, g in zip(w, grad_w, strict=True)],
        [x - rate * g for x, g in zip(b, grad_b, strict=True)],
    )


def test_double_overestimates_less_on_a_noisy_bandit():
    """State 0 leads to a bandit of ten arms that pay noise of mean 0: Q(0, .) is 0."""
    learned = {}
    for double in (True, False):
        rng = np.random.default_rng(7)
        online, target = Net((2, 10), "relu", rng), Net((2, 10), "relu", rng)
        copy_towards(target, online, 1.0)
        optimiser = torch.optim.SGD(online.parameters(), lr=0.5)
        seen = []
        for step in range(1500):
            rows = [(0, 0, 0.0, 0.9, 1, 0, 9)]
            rows += [(1, arm, rng.normal(), 0.0, 1, 0, 9) for arm in range(10)]
            td_update(online, target, optimiser, transitions(rows, 2), double=double, loss="mse")
            if step % 50 == 49:
                copy_towards(target, online, 1.0)
            if step >= 300:
                seen.append(forward(to_numpy(online), np.eye(2, dtype=np.float32))[0, 0])
        learned[double] = float(np.mean(seen))
    assert learned[False] > 0.1
    assert abs(learned[True]) < 0.5 * learned[False]


def test_hard_target_updates_copy_and_soft_ones_approach():
    rng = np.random.default_rng(0)
    online, target = Net((2, 3), "relu", rng), Net((2, 3), "relu", rng)
    before = to_numpy(target).weights[0]
    copy_towards(target, online, 0.25)
    expected = before + np.float32(0.25) * (to_numpy(online).weights[0] - before)
    assert np.allclose(to_numpy(target).weights[0], expected, atol=1e-7)
    copy_towards(target, online, 1.0)
    assert np.array_equal(to_numpy(target).weights[0], to_numpy(online).weights[0])


def test_target_net_moves_only_when_it_is_due():
    replay = Replay(10, 2)
    replay.add(transitions([(0, 0, 1.0, 0.9, 1, 0, 1)], 2))
    config = replace(SampledConfig(), hidden=(4,), target_every=3, target_rate=1.0, batch=4)
    learner = SampledLearner(
        2, 2, config, replay, np.random.default_rng(0), np.random.default_rng(1)
    )
    first = to_numpy(learner.target).weights[0]
    for _ in range(2):
        learner.update()
    assert np.array_equal(to_numpy(learner.target).weights[0], first)
    learner.update()
    assert np.array_equal(to_numpy(learner.target).weights[0], learner.network().weights[0])


@pytest.mark.parametrize("activation", ["relu", "tanh"])
def test_torch_and_numpy_forward_passes_agree(activation):
    net = Net((5, 64, 64, 1600), activation, np.random.default_rng(2))
    inputs = np.random.default_rng(3).normal(size=(32, 5)).astype(np.float32)
    numpy_q = forward(to_numpy(net), inputs)
    torch_q = net(torch.from_numpy(inputs)).detach().numpy()
    assert numpy_q.dtype == np.float32
    assert np.abs(numpy_q - torch_q).max() < 1e-6


def test_gathered_outputs_equal_the_dense_head():
    net = Net((5, 16, 40), "relu", np.random.default_rng(2))
    inputs = torch.from_numpy(np.random.default_rng(3).normal(size=(8, 5)).astype(np.float32))
    chosen = torch.arange(8) * 5
    dense = net(inputs).gather(1, chosen[:, None])[:, 0]
    assert torch.allclose(net.at(inputs, chosen), dense, atol=1e-6)
