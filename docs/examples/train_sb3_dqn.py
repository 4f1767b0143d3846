"""Train stable-baselines3's DQN on the plant and compare it with a rule.

    pip install '.[examples]'  # in a checkout; `make` has done so
    python docs/examples/train_sb3_dqn.py --steps 200000

It shows how another library's learner meets this environment: SB3 knows nothing of tractors, and
this file little of SB3. The project's own learner is `ems train`.
"""

from typing import Annotated

import gymnasium
import numpy as np
import torch
import typer
from gymnasium import spaces
from stable_baselines3 import DQN
from stable_baselines3.dqn.policies import DQNPolicy, QNetwork

from tractor_ems.drive import drive
from tractor_ems.policies.registry import make_rule
from tractor_ems.scenario import make_scenario
from tractor_msgs_py.errors import TractorEmsError
from tractor_sim.gym import ENV_ID

# --- The action mask ----------------------------------------------------------------------------
# SB3's DQN has no place for a mask. It is honoured at three places all the same:
#   exploration   SB3 draws from the action space, so the space draws from the present mask
#   greedy choice the network gives a masked action a value that is never the largest
#   target        max over the next state's actions goes through the same network
# For the last two the network must see the mask, so it is appended to the observation. The first
# works for one environment at a time: one space cannot know which of several it draws for.
# What SB3 cannot be told is that an infeasible action means the nearest feasible one (the plant
# clips it). It would have to replace the stored action by the one that was driven; with the mask
# honoured everywhere there is none to replace.

NEVER = -1e6
"""Value of a masked action. Rewards are about -1 a step, so no real value comes near."""


class MaskedDiscrete(spaces.Discrete):
    """Actions of which only the present mask's are drawn."""

    present: np.ndarray | None = None

    def sample(self, mask: np.ndarray | None = None, probability: np.ndarray | None = None):
        return super().sample(self.present if mask is None else mask, probability)


class MaskInObservation(gymnasium.Wrapper):
    """Appends the mask to the observation and tells it to the action space."""

    def __init__(self, env: gymnasium.Env) -> None:
        super().__init__(env)
        seen, count = env.observation_space, int(env.action_space.n)
        self.action_space = MaskedDiscrete(count)
        self.observation_space = spaces.Box(
            np.concatenate((seen.low, np.zeros(count, np.float32))),
            np.concatenate((seen.high, np.ones(count, np.float32))),
        )

    def reset(self, **kwargs):
        seen, info = self.env.reset(**kwargs)
        return self._with_mask(seen, info), info

    def step(self, action):
        seen, reward, terminated, truncated, info = self.env.step(action)
        return self._with_mask(seen, info), reward, terminated, truncated, info

    def _with_mask(self, seen, info):
        self.action_space.present = info["action_mask"]
        return np.concatenate((seen, info["action_mask"].astype(np.float32)))


class MaskedQNetwork(QNetwork):
    """Q values of an observation whose last elements are the mask."""

    def forward(self, obs):
        masked = obs[:, -int(self.action_space.n) :] < 0.5
        return super().forward(obs).masked_fill(masked, NEVER)


class MaskedDQNPolicy(DQNPolicy):
    """SB3's policy with the network above."""

    def make_q_net(self):
        arguments = self._update_features_extractor(self.net_args, features_extractor=None)
        return MaskedQNetwork(**arguments).to(self.device)


# --- Training and driving -----------------------------------------------------------------------


def make_env(powertrain: str, actions: int, **kwargs) -> gymnasium.Env:
    """The environment as DQN sees it."""
    env = gymnasium.make(ENV_ID, powertrain=powertrain, action_count=actions, **kwargs)
    return MaskInObservation(env)


def greedy_episode(model: DQN, env: gymnasium.Env, cycle: str) -> dict:
    """Drive a cycle greedily and return the infos of its last step."""
    seen, info = env.reset(seed=0, options={"cycle": cycle})
    over = False
    while not over:
        action, _ = model.predict(seen, deterministic=True)
        seen, _, _, over, info = env.step(int(action))
        if info["infeasible"]:
            raise RuntimeError("a masked action was chosen")
    return info


def run(
    steps: Annotated[int, typer.Option(min=1, help="Environment steps of training.")] = 200_000,
    powertrain: Annotated[str, typer.Option(help="Name, or YAML file.")] = "field",
    cycle: Annotated[str, typer.Option(help="What is driven at the end.")] = "planter_1001",
    rule: Annotated[str, typer.Option(help="The rule to compare with.")] = "never_stop_ecms",
    actions: Annotated[
        int, typer.Option(min=2, max=1000, help="Engine powers, off included.")
    ] = 21,
    seed: Annotated[int, typer.Option(min=0, help="Of training.")] = 0,
) -> None:
    """Train on the training cycles, then drive one cycle beside a rule."""
    torch.set_num_threads(1)  # the network is small: more threads only wait for each other
    try:
        scenario = make_scenario(powertrain, cycle)
        # Episodes start anywhere in the window, so that the value of charge is learnt everywhere.
        window = (scenario.params.battery.soc_min, scenario.params.battery.soc_max)
        train_env = make_env(powertrain, actions, soc_initial=window)
        baseline = make_rule(rule, scenario.params)
    except TractorEmsError as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(error.exit_code) from None

    model = DQN(
        MaskedDQNPolicy,
        train_env,
        learning_rate=5e-4,
        buffer_size=100_000,
        learning_starts=min(1000, steps // 4),
        batch_size=128,
        gamma=0.995,  # the battery's price makes most of a decision's cost immediate
        train_freq=4,
        target_update_interval=1000,
        exploration_fraction=0.3,
        exploration_final_eps=0.02,
        policy_kwargs={"net_arch": [128, 128]},
        seed=seed,
        device="cpu",
    )
    model.learn(steps, progress_bar=False)

    told = greedy_episode(model, make_env(powertrain, actions), cycle)
    (trajectory,) = drive(
        baseline,
        scenario.params,
        scenario.power_demand_w[None, :],
        scenario.soc_initial,
        scenario.soc_target,
    )
    rows = {
        f"DQN, {steps} steps": (
            told["episode_fuel_kg"],
            told["soc"],
            told["episode_starts"],
            told["episode_shortfall_j"],
        ),
        rule: (
            trajectory.fuel_kg.sum(),
            trajectory.soc_final,
            np.sum(np.diff(np.r_[False, trajectory.engine_on].astype(int)) == 1),
            trajectory.shortfall_j.sum(),
        ),
    }
    # Fuel at different final SOC is not the same work. `ems evaluate` gives the ratio to an exact
    # optimum that ends at the run's own SOC; here the difference is at least in the table.
    typer.echo(f"{cycle} on {powertrain}, SOC {scenario.soc_initial:.3f} at the start")
    typer.echo(f"{'':24s} {'fuel kg':>9s} {'final SOC':>10s} {'starts':>7s} {'shortfall MJ':>13s}")
    for name, (fuel_kg, soc, starts, shortfall_j) in rows.items():
        typer.echo(
            f"{name:24s} {fuel_kg:9.3f} {soc:10.4f} {int(starts):7d} {shortfall_j / 1e6:13.3f}"
        )


if __name__ == "__main__":
    typer.run(run)
