"""The sampled learner: double DQN or DQN on a replay, as a training run drives it.

The update itself is ``dqn_kernel.td_update``; here are its schedule, its replay and what of a run
goes into a checkpoint.
"""

from typing import Any

import numpy as np

from tractor_ems.learning.config import SampledConfig, learning_rate
from tractor_ems.learning.dqn_kernel import (
    Batch,
    Rule,
    as_arrays,
    make_adam,
    make_workspace,
    move_target,
    random_net,
    td_update,
    zero_net,
)
from tractor_ems.learning.replay import Replay, columns
from tractor_ems.policies.mlp import Mlp


class SampledLearner:
    """Networks, optimiser, replay and generator of one run; :meth:`update` is one step."""

    def __init__(
        self,
        inputs: int,
        actions: int,
        config: SampledConfig,
        replay: Replay,
        init_rng: np.random.Generator,
        sample_rng: np.random.Generator,
    ) -> None:
        self.config, self.replay, self.rng, self.step = config, replay, sample_rng, 0
        self.rule = Rule(
            double=config.double,
            huber=config.loss == "huber",
            tanh=config.activation == "tanh",
            margin=0.0,
        )
        sizes = (inputs, *config.hidden, actions)
        self.online, self.target = random_net(sizes, init_rng), zero_net(sizes)
        move_target(self.target, self.online, 1.0)
        self.adam = make_adam(sizes)
        self.work = make_workspace(sizes, config.batch)

    def update(self) -> dict[str, float]:
        """Replay one batch; move the target net when it is due."""
        config = self.config
        rate = learning_rate(config, self.step)
        batch = Batch(**columns(self.replay.sample(self.rng, config.batch)), experts=0)
        self.step += 1
        loss, q = td_update(
            self.online, self.target, self.adam, self.work, batch, self.rule, rate, self.step
        )
        if self.step % config.target_every == 0:
            move_target(self.target, self.online, config.target_rate)
        return {"losses/td_loss": loss, "losses/q_values": q}

    def network(self) -> Mlp:
        """A copy of the online network, for a policy."""
        return Mlp(**as_arrays(self.online), activation=self.config.activation)

    def tensors(self) -> dict[str, Any]:
        """Everything of the run that is an array, the replay included; no copies."""
        return {**self._parameters(), **self.replay.tensors()}

    def state(self) -> dict[str, Any]:
        """Everything else: step, generator, where the replay goes on."""
        return {
            "step": self.step,
            "sample_rng": self.rng.bit_generator.state,
            "replay": [self.replay.size, self.replay.next],
        }

    def restore(self, tensors: dict[str, Any], state: dict[str, Any]) -> None:
        """Continue where :meth:`tensors` and :meth:`state` were taken."""
        for name, values in self._parameters().items():
            values[:] = tensors[name]
        self.step = int(state["step"])
        self.rng.bit_generator.state = state["sample_rng"]
        self.replay.restore(tensors, *state["replay"])

    def _parameters(self) -> dict[str, Any]:
        return {
            "online": self.online.flat,
            "target": self.target.flat,
            "adam.mean": self.adam.mean,
            "adam.square": self.adam.square,
        }
