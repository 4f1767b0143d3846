"""The example that trains stable-baselines3 runs as its documentation says."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

EXAMPLE = Path(__file__).resolve().parents[2] / "docs" / "examples" / "train_sb3_dqn.py"


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, str(EXAMPLE), *arguments], text=True, capture_output=True, timeout=250
    )


@pytest.mark.slow
def test_the_example_trains_and_prints_fuel_and_final_soc_beside_a_rule():
    done = run("--steps", "400", "--cycle", "planter")
    assert done.returncode == 0, done.stderr
    learned, rule = done.stdout.splitlines()[-2:]
    assert learned.startswith("DQN, 400 steps") and rule.startswith("never_stop_ecms")
    for row in (learned, rule):
        fuel_kg, soc, starts, _ = (float(word) for word in row.split()[-4:])
        assert fuel_kg > 0 and 0.3 <= soc <= 0.8 and starts >= 1


@pytest.mark.slow
def test_the_example_refuses_an_unknown_powertrain_in_one_line():
    done = run("--powertrain", "tank")
    assert done.returncode == 2
    assert done.stderr.startswith("error: ") and done.stderr.count("\n") == 1


@pytest.mark.slow
def test_exploration_greedy_choice_and_target_all_honour_the_mask():
    torch = pytest.importorskip("torch")
    spec = importlib.util.spec_from_file_location("train_sb3_dqn", EXAMPLE)
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    env = example.make_env("field", 21, cycles="planter")
    model = example.DQN(example.MaskedDQNPolicy, env, learning_starts=50, seed=1, device="cpu")
    model.learn(300)
    stored = model.replay_buffer
    masks = stored.observations[:300, 0, -21:]
    taken = stored.actions[:300, 0, 0]
    assert np.all(masks[np.arange(300), taken] == 1.0)
    seen = torch.as_tensor(stored.next_observations[:300, 0])
    with torch.no_grad():
        values = model.q_net_target(seen)
    assert torch.all(values.max(dim=1).values > example.NEVER / 2)
    assert torch.all(values[seen[:, -21:] == 0.0] == example.NEVER)
