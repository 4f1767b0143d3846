"""A Q network as one flat vector, with Adam over it, for compiled updates; torch is not needed.

What a network learns from is ``dqn_kernel``; what a policy runs on is ``policies.mlp``.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numba.extending import register_jitable

from tractor_ems.policies.mlp import Float32Array
from tractor_msgs_py.trajectory import IntArray

FAST = {"reassoc", "contract", "nsz", "arcp"}
"""Sums may be reordered, which vectorises them; NaN and infinity keep their meaning."""

TINY = 1e-30
"""Moments below this become zero: an action that is never taken would else decay into
denormal numbers, which processors multiply a hundred times slower."""

BETA1, BETA2, ADAM_EPS = 0.9, 0.999, 1e-8


class QNet(NamedTuple):
    """Fully connected layers in one flat vector, so that one compiled update serves any depth.

    Attributes:
        flat: every parameter, shape (P,); by layer weights (inputs, outputs), then biases.
        sizes: widths from input to output, shape (layers + 1,).
    """

    flat: Float32Array
    sizes: IntArray


class Adam(NamedTuple):
    """Gradient and moments, each laid out like the parameters; ``gradient.flat`` is zero between
    updates."""

    gradient: QNet
    mean: Float32Array
    square: Float32Array


def net_of(sizes: Sequence[int], flat: Float32Array) -> QNet:
    """The net of a flat parameter vector, shape (parameters(sizes),); not a copy."""
    return QNet(flat, np.array(sizes, np.int64))


def parameters(sizes: Sequence[int]) -> int:
    """Number of weights and biases."""
    return sum((a + 1) * b for a, b in pairwise(sizes))


def zero_net(sizes: Sequence[int]) -> QNet:
    """All zero."""
    return net_of(sizes, np.zeros(parameters(sizes), np.float32))


def random_net(sizes: Sequence[int], rng: np.random.Generator) -> QNet:
    """Weights and biases uniform in +-1/sqrt(inputs), drawn from ``rng``."""
    net = zero_net(sizes)
    for n in range(len(sizes) - 1):
        weight, bias = layer(net, n)
        bound = len(weight) ** -0.5
        # Drawn output by output, the order in which networks.Net draws.
        weight[:] = rng.uniform(-bound, bound, weight.shape[::-1]).astype(np.float32).T
        bias[:] = rng.uniform(-bound, bound, bias.shape).astype(np.float32)
    return net


@register_jitable
def layer(net: QNet, n: int) -> tuple[Float32Array, Float32Array]:
    """Views of the weights (inputs, outputs) and biases (outputs,) of layer ``n`` from 0."""
    at = 0
    for m in range(n):
        at += (net.sizes[m] + 1) * net.sizes[m + 1]
    inputs, outputs = net.sizes[n], net.sizes[n + 1]
    middle = at + inputs * outputs
    weight = net.flat[at:middle].reshape(inputs, outputs)
    return weight, net.flat[middle : middle + outputs]


@register_jitable
def head(net: QNet) -> tuple[Float32Array, Float32Array]:
    """The last layer, see :func:`layer`."""
    return layer(net, len(net.sizes) - 2)


def make_adam(sizes: Sequence[int]) -> Adam:
    """At rest."""
    count = parameters(sizes)
    return Adam(zero_net(sizes), np.zeros(count, np.float32), np.zeros(count, np.float32))


@njit(cache=True, error_model="numpy", fastmath=FAST)
def adam_step(flat: Float32Array, adam: Adam, learning_rate: float, step: int) -> None:
    """Adam with bias correction over every parameter; leaves the gradient zero.

    The factors are float32 literals' worth: a float64 among them would halve the vector width.
    """
    gradient, mean, square = adam.gradient.flat, adam.mean, adam.square
    b1, c1 = np.float32(BETA1), np.float32(1.0 - BETA1)
    b2, c2 = np.float32(BETA2), np.float32(1.0 - BETA2)
    rate = np.float32(learning_rate / (1.0 - BETA1**step))
    root = np.float32(1.0 / np.sqrt(1.0 - BETA2**step))
    eps, zero, tiny = np.float32(ADAM_EPS), np.float32(0.0), np.float32(TINY)
    for p in range(len(flat)):
        g = gradient[p]
        m = b1 * mean[p] + c1 * g
        v = b2 * square[p] + c2 * g * g
        m = m if abs(m) > tiny else zero
        v = v if v > tiny else zero
        mean[p], square[p], gradient[p] = m, v, zero
        flat[p] -= rate * m / (np.sqrt(v) * root + eps)


@njit(cache=True, error_model="numpy", fastmath=FAST)
def move_target(target: QNet, online: QNet, rate: float) -> None:
    """target += rate (online - target); rate 1 is a hard copy."""
    t, o = target.flat, online.flat
    if rate >= 1.0:
        t[:] = o
        return
    r = np.float32(rate)
    for p in range(len(t)):
        t[p] += r * (o[p] - t[p])


def as_arrays(net: QNet) -> dict[str, Any]:
    """Weights (outputs, inputs) and biases by layer, as ``policies.mlp`` wants them; copies."""
    layers = [layer(net, n) for n in range(len(net.sizes) - 1)]
    return {
        "weights": tuple(np.ascontiguousarray(weight.T) for weight, _ in layers),
        "biases": tuple(bias.copy() for _, bias in layers),
    }
