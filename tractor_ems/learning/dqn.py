"""DQN and double DQN on replayed transitions, the whole update on one screen.

    a* = argmax_a Q(s', a; theta)      over the feasible a       (double; DQN: theta^-)
    y  = r + gamma Q(s', a*; theta^-)
    theta <- theta - alpha grad Huber(Q(s, a; theta) - y)

Infeasible actions are masked in the bootstrap too: a network says anything about actions nobody
can take, and the largest of such values would leak into every target.
"""

from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from tractor_ems.learning.config import SampledConfig, learning_rate
from tractor_ems.learning.networks import (
    Net,
    adam_tensors,
    copy_towards,
    load_adam,
    load_net,
    net_tensors,
    to_numpy,
)
from tractor_ems.learning.replay import Replay, Transitions
from tractor_ems.policies.action_grid import in_range
from tractor_ems.policies.mlp import Float32Array, Mlp


def feasible_q(net: Net, inputs: Tensor, batch: Transitions) -> Float32Array:
    """Q of every action in the next states, shape (B, actions), -inf where infeasible.

    Mask and argmax in numpy: it is ten times faster at them than torch on one thread.
    """
    q: Float32Array = net(inputs).numpy()
    np.copyto(q, -np.inf, where=~in_range(batch.next_first, batch.next_last, q.shape[1]))
    return q


@torch.no_grad()
def td_target(online: Net, target: Net, batch: Transitions, *, double: bool) -> Tensor:
    """y of a batch, shape (B,)."""
    next_inputs = torch.from_numpy(batch.next_inputs)
    if double:
        chosen = feasible_q(online, next_inputs, batch).argmax(axis=1)
        next_q = target.at(next_inputs, torch.from_numpy(chosen))
    else:
        next_q = torch.from_numpy(feasible_q(target, next_inputs, batch).max(axis=1))
    return torch.from_numpy(batch.reward) + torch.from_numpy(batch.discount) * next_q


def td_update(
    online: Net,
    target: Net,
    optimiser: torch.optim.Optimizer,
    batch: Transitions,
    *,
    double: bool = True,
    loss: Literal["huber", "mse"] = "huber",
) -> tuple[Tensor, Tensor]:
    """One gradient step of the online net; returns loss and mean Q of the batch."""
    y = td_target(online, target, batch, double=double)
    q = online.at(torch.from_numpy(batch.inputs), torch.from_numpy(batch.action))
    error = (torch.nn.functional.huber_loss if loss == "huber" else torch.nn.functional.mse_loss)(
        q, y
    )
    optimiser.zero_grad(set_to_none=True)
    error.backward()  # type: ignore[no-untyped-call]
    optimiser.step()
    return error.detach(), q.detach().mean()


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
        sizes = (inputs, *config.hidden, actions)
        self.online = Net(sizes, config.activation, init_rng)
        self.target = Net(sizes, config.activation, init_rng)
        copy_towards(self.target, self.online, 1.0)
        self.optimiser = torch.optim.Adam(
            self.online.parameters(), lr=config.learning_rate, fused=True
        )

    def update(self) -> dict[str, Tensor]:
        """Replay one batch; move the target net when it is due."""
        config = self.config
        self.optimiser.param_groups[0]["lr"] = learning_rate(config, self.step)
        batch = self.replay.sample(self.rng, config.batch)
        loss, q = td_update(
            self.online,
            self.target,
            self.optimiser,
            batch,
            double=config.double,
            loss=config.loss,
        )
        self.step += 1
        if self.step % config.target_every == 0:
            copy_towards(self.target, self.online, config.target_rate)
        return {"losses/td_loss": loss, "losses/q_values": q}

    def network(self) -> Mlp:
        """The online network, for a policy."""
        return to_numpy(self.online)

    def tensors(self) -> dict[str, Any]:
        """Everything of the run that is an array, the replay included."""
        return {
            **net_tensors(self.online, "online"),
            **net_tensors(self.target, "target"),
            **adam_tensors(self.optimiser),
            **self.replay.tensors(),
        }

    def state(self) -> dict[str, Any]:
        """Everything else: step, generator, where the replay goes on."""
        return {
            "step": self.step,
            "sample_rng": self.rng.bit_generator.state,
            "replay": [self.replay.size, self.replay.next],
        }

    def restore(self, tensors: dict[str, Any], state: dict[str, Any]) -> None:
        """Continue where :meth:`tensors` and :meth:`state` were taken."""
        load_net(self.online, tensors, "online")
        load_net(self.target, tensors, "target")
        load_adam(self.optimiser, tensors)
        self.step = int(state["step"])
        self.rng.bit_generator.state = state["sample_rng"]
        self.replay.restore(tensors, *state["replay"])
