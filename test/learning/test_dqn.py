"""The sampled learner: what it reaches, when it moves its target net, and what it does without."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tractor_ems.learning.checkpoint import checkpoint_path
from tractor_ems.learning.config import SampledConfig, load_train_config
from tractor_ems.learning.dqn import SampledLearner
from tractor_ems.learning.networks import Net, to_numpy
from tractor_ems.learning.recordings import Recordings
from tractor_ems.learning.replay import Replay, Transitions
from tractor_ems.learning.train import train_on
from tractor_ems.policies.mlp import forward
from tractor_msgs_py.errors import RunAborted


def transitions(rows: list[tuple[int, int, float, float, int, int, int]], states: int):
    """(state, action, reward, discount, next state, next first, next last), one-hot inputs."""
    state, action, reward, discount, following, first, last = zip(*rows, strict=True)
    eye = np.eye(states, dtype=np.float32)
    return Transitions(
        inputs=eye[list(state)],
        action=np.array(action, dtype=np.int64),
        reward=np.array(reward, dtype=np.float32),
        discount=np.array(discount, dtype=np.float32),
        next_inputs=eye[list(following)],
        first=np.zeros(len(rows), dtype=np.int16),
        last=np.zeros(len(rows), dtype=np.int16),
        next_first=np.array(first, dtype=np.int16),
        next_last=np.array(last, dtype=np.int16),
    )


def learner_of(rows: Transitions, actions: int, config: SampledConfig) -> SampledLearner:
    replay = Replay(100, rows.inputs.shape[1])
    replay.add(rows)
    rngs = (np.random.default_rng(0), np.random.default_rng(1))
    return SampledLearner(rows.inputs.shape[1], actions, config, replay, *rngs)


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


@pytest.mark.parametrize(
    "double", [True, pytest.param(False, marks=pytest.mark.slow)], ids=["double", "single"]
)
@pytest.mark.parametrize("seed", [3, *(pytest.param(s, marks=pytest.mark.slow) for s in (4, 5))])
def test_learner_reaches_q_star_of_a_small_mdp_within_1_percent(double: bool, seed: int):
    """Every state has infeasible actions, which are never tried: what the network says of them
    is anything, and must not matter."""
    mdp = random_mdp(seed)
    reward, following, first, last = mdp
    rows = [
        (s, a, reward[s, a], GAMMA, n := int(following[s, a]), int(first[n]), int(last[n]))
        for s in range(STATES)
        for a in range(first[s], last[s] + 1)
    ]
    config = SampledConfig(
        updates=6000, batch=32, learning_rate=5e-3, target_rate=0.1, hidden=(32,), double=double
    )
    learner = learner_of(transitions(rows, STATES), ACTIONS, config)
    for _ in range(config.updates):
        learner.update()
    learned = forward(learner.network(), np.eye(STATES, dtype=np.float32))
    q_star = value_iteration(mdp)
    known = np.isfinite(q_star)
    assert not known.all(axis=1).all()
    assert np.abs(learned - q_star)[known].max() < 0.01 * np.abs(q_star[known]).max()
    assert q_star[0, 2] > q_star[0, 1]
    assert learned[0, 2] > learned[0, 1], "fell into the myopic trap"


def test_target_net_moves_only_when_it_is_due():
    config = SampledConfig(hidden=(4,), target_every=3, target_rate=1.0, batch=4)
    learner = learner_of(transitions([(0, 0, 1.0, 0.9, 1, 0, 1)], 2), 2, config)
    before = learner.target.flat.copy()
    assert np.array_equal(before, learner.online.flat), "the nets start equal"
    for _ in range(2):
        learner.update()
    assert np.array_equal(learner.target.flat, before)
    learner.update()
    assert np.array_equal(learner.target.flat, learner.online.flat)
    assert not np.array_equal(learner.target.flat, before)


@pytest.mark.parametrize("loss", ["huber", "mse"])
def test_the_loss_that_is_reported_is_that_of_the_setting(loss: str):
    """An error of 3: 2.5 by Huber, 4.5 by half its square."""
    config = SampledConfig(hidden=(4,), batch=2, loss=loss, learning_rate=1e-9)
    learner = learner_of(transitions([(0, 0, 0.0, 0.0, 1, 0, 1)], 2), 2, config)
    q = forward(learner.network(), np.eye(2, dtype=np.float32))[0, 0]
    learner.replay.columns["reward"][:] = q + 3.0
    metrics = learner.update()
    assert metrics["losses/td_loss"] == pytest.approx(2.5 if loss == "huber" else 4.5, rel=1e-5)
    assert metrics["losses/q_values"] == pytest.approx(q, rel=1e-5)


def test_a_restored_learner_goes_on_to_the_same_bytes():
    """One run unbroken, the other continued by a learner that was made from another seed."""
    config = SampledConfig(hidden=(8, 8), batch=8, activation="tanh", target_every=5)
    rows = transitions([(s, s % 3, s * 0.5, 0.9, 5 - s, 0, s % 3) for s in range(6)], 6)
    whole, second = learner_of(rows, 3, config), learner_of(rows.take(np.array([0])), 3, config)
    for _ in range(17):
        whole.update()
    tensors = {name: value.copy() for name, value in whole.tensors().items()}
    second.restore(tensors, whole.state())
    for learner in (whole, second):
        for _ in range(13):
            learner.update()
    for name, value in whole.tensors().items():
        assert value.tobytes() == second.tensors()[name].tobytes(), name


def test_the_network_of_a_policy_is_a_copy():
    config = SampledConfig(hidden=(4,), batch=4)
    learner = learner_of(transitions([(0, 0, 1.0, 0.9, 1, 0, 1)], 2), 2, config)
    network = learner.network()
    before = [w.tobytes() for w in network.weights]
    learner.update()
    assert [w.tobytes() for w in network.weights] == before
    assert [w.tobytes() for w in learner.network().weights] != before


@pytest.mark.parametrize("activation", ["relu", "tanh"])
def test_torch_numpy_and_compiled_nets_start_alike(activation):
    """One generator draws one net, whoever trains it."""
    config = SampledConfig(hidden=(64, 64), activation=activation)
    learner = learner_of(transitions([(0, 0, 1.0, 0.9, 1, 0, 1)], 5), 1600, config)
    net = Net((5, 64, 64, 1600), activation, np.random.default_rng(0))
    inputs = np.random.default_rng(3).normal(size=(32, 5)).astype(np.float32)
    torch_q = net(torch.from_numpy(inputs)).detach().numpy()
    for mlp in (to_numpy(net), learner.network()):
        q = forward(mlp, inputs)
        assert q.dtype == np.float32
        assert np.abs(q - torch_q).max() < 1e-6


@pytest.mark.parametrize(
    "value", [np.nan, *(pytest.param(v, marks=pytest.mark.slow) for v in (np.inf, 1e38))]
)
def test_a_diverged_run_is_aborted_and_leaves_nothing(
    value: float, paper, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    config = load_train_config(
        "sampled", {"updates": 20, "sampled.hidden": [8], "sampled.batch": 8, "interact": 1}
    )
    update = SampledLearner.update

    def poison(learner: SampledLearner):
        if learner.step == 6:
            learner.online.flat[:] = value
        return update(learner)

    monkeypatch.setattr(SampledLearner, "update", poison)
    out = tmp_path / "p.safetensors"
    with pytest.raises(RunAborted, match="diverged at update 7: loss is"):
        train_on(config, paper, Recordings(dp=(), rule=()), out)
    assert not out.exists() and not checkpoint_path(out).exists()


NO_TORCH = """
import sys
from pathlib import Path
sys.modules["torch"] = None
from tractor_ems.learning.config import load_train_config
from tractor_ems.learning.recordings import Recordings
from tractor_ems.learning.train import train_on
from tractor_msgs_py.errors import ConfigError
from tractor_sim.config import load_powertrain
for preset in ("sampled", "counterfactual"):
    config = load_train_config(preset, {"updates": 5, "interact": 1, "sampled.hidden": [8]})
    out, nothing = Path(sys.argv[1]) / "p.safetensors", Recordings(dp=(), rule=())
    try:
        print(train_on(config, load_powertrain("paper"), nothing, out).updates)
    except ConfigError as error:
        print(error)
"""


@pytest.mark.slow
def test_torch_is_needed_for_counterfactual_targets_alone(tmp_path: Path):
    done = subprocess.run(
        [sys.executable, "-c", NO_TORCH, str(tmp_path)],
        text=True,
        capture_output=True,
        timeout=240,
    )
    trained, refused = done.stdout.splitlines() or [done.stderr, ""]
    assert trained == "5"
    assert refused.startswith("targets counterfactual: training needs torch: pip install")


def test_another_seed_of_sampling_changes_the_batches():
    rows = transitions([(s, 0, float(s), 0.0, 0, 0, 1) for s in range(6)], 6)
    config = SampledConfig(hidden=(4,), batch=4)
    first, second = learner_of(rows, 2, config), learner_of(rows, 2, replace(config))
    second.rng = np.random.default_rng(99)
    for learner in (first, second):
        for _ in range(5):
            learner.update()
    assert first.online.flat.tobytes() != second.online.flat.tobytes()
