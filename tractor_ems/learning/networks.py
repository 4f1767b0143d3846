"""Networks to train, in torch: built from an explicit generator, exported to numpy. Policies run
on ``policies.mlp``; this module is imported by training alone, because torch is slow to import.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tractor_ems.policies.mlp import Activation, Float32Array, Mlp

_ACTIVATIONS = {"relu": torch.relu, "tanh": torch.tanh}


class Net:
    """Fully connected layers; the torch twin of ``policies.mlp.Mlp``.

    Plain tensors rather than an ``nn.Module``: for nets this small the module's attribute look-ups
    cost as much as the arithmetic.
    """

    def __init__(
        self, sizes: Sequence[int], activation: Activation, rng: np.random.Generator
    ) -> None:
        """Weights and biases uniform in +-1/sqrt(inputs), drawn from ``rng``."""
        self.activation: Activation = activation
        self.weights: list[Tensor] = []
        self.biases: list[Tensor] = []
        for inputs, outputs in pairwise(sizes):
            bound = inputs**-0.5
            for group, shape in ((self.weights, (outputs, inputs)), (self.biases, (outputs,))):
                drawn = rng.uniform(-bound, bound, shape).astype(np.float32)
                group.append(torch.from_numpy(drawn).requires_grad_())

    def parameters(self) -> list[Tensor]:
        """Every tensor that is learned, in a fixed order."""
        return [*self.weights, *self.biases]

    def named(self) -> dict[str, Tensor]:
        """The same by name."""
        weights = {f"layer{n}.weight": w for n, w in enumerate(self.weights)}
        return weights | {f"layer{n}.bias": b for n, b in enumerate(self.biases)}

    def hidden(self, inputs: Tensor) -> Tensor:
        """Last hidden layer, shape (B, width)."""
        act = _ACTIVATIONS[self.activation]
        values = inputs
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            values = act(torch.addmm(bias, values, weight.T))
        return values

    def __call__(self, inputs: Tensor) -> Tensor:
        """All outputs, shape (B, outputs)."""
        return torch.addmm(self.biases[-1], self.hidden(inputs), self.weights[-1].T)


def to_numpy(net: Net) -> Mlp:
    """A copy for the policies."""
    return Mlp(
        tuple(w.detach().numpy().copy() for w in net.weights),
        tuple(b.detach().numpy().copy() for b in net.biases),
        net.activation,
    )


@torch.no_grad()
def copy_towards(target: Net, online: Net, rate: float) -> None:
    """target += rate (online - target); rate 1 is a hard copy."""
    torch._foreach_lerp_(target.parameters(), online.parameters(), rate)


def net_tensors(net: Net, prefix: str) -> dict[str, Float32Array]:
    """Named copies of every parameter."""
    return {f"{prefix}.{name}": p.detach().numpy().copy() for name, p in net.named().items()}


@torch.no_grad()
def load_net(net: Net, tensors: Mapping[str, Any], prefix: str) -> None:
    """Inverse of :func:`net_tensors`; raises KeyError or RuntimeError on other shapes."""
    for name, parameter in net.named().items():
        parameter.copy_(torch.from_numpy(np.array(tensors[f"{prefix}.{name}"])))


def adam_tensors(optimiser: torch.optim.Adam) -> dict[str, Float32Array]:
    """Step counts and moments of Adam, by parameter number."""
    tensors = {}
    for number, state in optimiser.state_dict()["state"].items():
        for name, value in state.items():
            tensors[f"adam.{number}.{name}"] = value.detach().numpy().copy()
    return tensors


def load_adam(optimiser: torch.optim.Adam, tensors: Mapping[str, Any]) -> None:
    """Inverse of :func:`adam_tensors`; the learning rate is the schedule's business."""
    state: dict[int, dict[str, Tensor]] = {}
    for key, value in tensors.items():
        if key.startswith("adam."):
            _, number, name = key.split(".")
            state.setdefault(int(number), {})[name] = torch.from_numpy(np.array(value))
    whole = optimiser.state_dict()
    whole["state"] = state
    optimiser.load_state_dict(whole)


@contextmanager
def one_thread() -> Iterator[None]:
    """Run torch on one thread, so that sums are taken in one order and bytes are repeatable."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


class Resumable:
    """What every learner of an online and an averaged network keeps in a checkpoint.

    Attributes:
        online, target: the networks; adam: of the online one.
        step: gradient steps done; rng: draws the samples.
    """

    online: Net
    target: Net
    adam: torch.optim.Adam
    step: int
    rng: np.random.Generator

    def tensors(self) -> dict[str, Any]:
        """Everything of the run that is an array."""
        return {
            **net_tensors(self.online, "online"),
            **net_tensors(self.target, "target"),
            **adam_tensors(self.adam),
        }

    def state(self) -> dict[str, Any]:
        """Everything else: step and generator."""
        return {"step": self.step, "sample_rng": self.rng.bit_generator.state}

    def restore(self, tensors: dict[str, Any], state: dict[str, Any]) -> None:
        """Continue where :meth:`tensors` and :meth:`state` were taken."""
        load_net(self.online, tensors, "online")
        load_net(self.target, tensors, "target")
        load_adam(self.adam, tensors)
        self.step = int(state["step"])
        self.rng.bit_generator.state = state["sample_rng"]
