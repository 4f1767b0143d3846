"""Updates per second of the sampled learner, beside stable-baselines3 where that is installed.

A report, not a test: python test/learning/benchmark_dqn.py [updates]
"""

import sys
import time
from collections.abc import Callable

import numpy as np

from tractor_ems.learning.config import SampledConfig
from tractor_ems.learning.dqn import SampledLearner
from tractor_ems.learning.dqn_kernel import Batch, td_update
from tractor_ems.learning.replay import Replay, Transitions, columns

INPUTS, HIDDEN, BATCH, STORED, ROUNDS = 2, (64, 64), 64, 20_000, 9
FEASIBLE = 0.65
"""Share of the actions that is feasible, about the paper's."""


def filled_replay(actions: int, rng: np.random.Generator) -> Replay:
    width = max(int(FEASIBLE * actions), 1)
    first = rng.integers(0, actions - width + 1, (2, STORED)).astype(np.int16)
    last = (first + width - 1).astype(np.int16)
    replay = Replay(STORED, INPUTS)
    replay.add(
        Transitions(
            inputs=rng.normal(size=(STORED, INPUTS)).astype(np.float32),
            action=rng.integers(first[0], last[0].astype(np.int64) + 1),
            reward=rng.normal(size=STORED).astype(np.float32),
            discount=np.full(STORED, 0.98, np.float32),
            next_inputs=rng.normal(size=(STORED, INPUTS)).astype(np.float32),
            first=first[0],
            last=last[0],
            next_first=first[1],
            next_last=last[1],
        )
    )
    return replay


def own_updates(actions: int, *, with_replay: bool) -> Callable[[int], None]:
    """The learner's update: sampling, gradient step and soft target; or the step alone."""
    rng = np.random.default_rng(0)
    config = SampledConfig(updates=10**6, batch=BATCH, hidden=HIDDEN)
    learner = SampledLearner(INPUTS, actions, config, filled_replay(actions, rng), rng, rng)
    batch = Batch(**columns(learner.replay.sample(rng, BATCH)), experts=0)

    def run(count: int) -> None:
        for _ in range(count):
            if with_replay:
                learner.update()
            else:
                learner.step += 1
                td_update(
                    learner.online,
                    learner.target,
                    learner.adam,
                    learner.work,
                    batch,
                    learner.rule,
                    1e-3,
                    learner.step,
                )

    return run


def sb3_updates(actions: int) -> Callable[[int], None] | None:
    """stable-baselines3's ``DQN.train``: sampling and gradient step, plain DQN without a mask and
    without the target update; None where it is not installed."""
    try:
        import gymnasium
        import torch
        from stable_baselines3 import DQN
        from stable_baselines3.common.logger import configure
    except ImportError:
        return None
    torch.set_num_threads(1)

    class Idle(gymnasium.Env):  # type: ignore[misc]
        observation_space = gymnasium.spaces.Box(-9.0, 9.0, (INPUTS,), np.float32)
        action_space = gymnasium.spaces.Discrete(actions)

    settings = {"net_arch": list(HIDDEN)}
    agent = DQN(
        "MlpPolicy",
        Idle(),
        batch_size=BATCH,
        buffer_size=STORED,
        policy_kwargs=settings,
        device="cpu",
    )
    agent.set_logger(configure(None, []))
    stored = filled_replay(actions, np.random.default_rng(0)).columns
    for n in range(STORED):
        agent.replay_buffer.add(
            stored["inputs"][n],
            stored["next_inputs"][n],
            stored["action"][n : n + 1],
            stored["reward"][n : n + 1],
            np.zeros(1, bool),
            [{}],
        )

    def run(count: int) -> None:
        agent.train(count, BATCH)

    return run


def main() -> None:
    updates = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    print(f"inputs {INPUTS}, hidden {HIDDEN}, batch {BATCH}, CPU time of one thread;")
    print(f"median (best) of {ROUNDS} rounds of {updates} updates, taken in turn")
    for actions in (1600, 65):
        runs = {
            "td_update alone": own_updates(actions, with_replay=False),
            "SampledLearner.update": own_updates(actions, with_replay=True),
            "stable-baselines3 DQN.train": sb3_updates(actions),
        }
        present = {name: run for name, run in runs.items() if run is not None}
        rates: dict[str, list[float]] = {name: [] for name in present}
        for run in present.values():
            run(20)
        for _ in range(ROUNDS):
            for name, run in present.items():
                begin_s = time.process_time()
                run(updates)
                rates[name].append(updates / (time.process_time() - begin_s))
        for name, found in rates.items():
            rate = float(np.median(found))
            print(
                f"{actions:5d} actions  {name:28s} {rate:7.0f} ({max(found):.0f}) updates/s "
                f"{rate * BATCH:9.0f} transitions/s"
            )
        theirs = rates.get("stable-baselines3 DQN.train")
        if theirs:
            ratio = np.median(np.array(rates["SampledLearner.update"]) / np.array(theirs))
            print(f"{actions:5d} actions  learner over stable-baselines3: {ratio:.2f}")


if __name__ == "__main__":
    main()
