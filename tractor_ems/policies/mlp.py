"""A small fully connected network in numpy: the forward pass a policy needs, nothing else."""

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

Float32Array: TypeAlias = NDArray[np.float32]
Activation = Literal["relu", "tanh"]


@dataclass(frozen=True)
class Mlp:
    """Layers y = x W^T + b with an activation between them.

    Attributes:
        weights: shapes (out, in), float32.
        biases: shapes (out,), float32.
        activation: of every layer but the last.
    """

    weights: tuple[Float32Array, ...]
    biases: tuple[Float32Array, ...]
    activation: Activation = "relu"

    @property
    def inputs(self) -> int:
        """Number of inputs."""
        return int(self.weights[0].shape[1])

    @property
    def outputs(self) -> int:
        """Number of outputs."""
        return int(self.weights[-1].shape[0])


def forward(net: Mlp, inputs: Float32Array) -> Float32Array:
    """Outputs of shape (B, outputs) for inputs of shape (B, inputs), float32."""
    values = inputs
    last = len(net.weights) - 1
    for number, (weight, bias) in enumerate(zip(net.weights, net.biases, strict=True)):
        values = values @ weight.T + bias
        if number < last:
            if net.activation == "relu":
                values = np.maximum(values, np.float32(0.0))
            else:
                values = np.tanh(values)
    return values
