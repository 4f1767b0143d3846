"""DQN and double DQN, compiled: the whole update on one screen, :func:`td_update`.

    a* = argmax_a Q(s', a; theta)      over the feasible a       (double; DQN: theta^-)
    y  = r + gamma Q(s', a*; theta^-)
    theta <- theta - alpha Adam(grad Huber(Q(s, a; theta) - y))

Infeasible actions are masked in the bootstrap too: a network says anything about actions nobody
can take, and the largest of such values would leak into every target.

With 1600 outputs the head is all of the cost. Forward, only feasible actions are computed, in
tiles that stay in a near cache; backward, only the chosen action's column has a gradient.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from tractor_ems.learning.q_net import (
    FAST,
    Adam,
    QNet,
    adam_step,
    as_arrays,
    head,
    layer,
    make_adam,
    move_target,
    net_of,
    parameters,
    random_net,
    zero_net,
)
from tractor_ems.policies.mlp import Float32Array

__all__ = [
    "FAST", "TILE", "Adam", "Batch", "QNet", "Rule", "Workspace", "as_arrays", "best_actions",
    "forward", "make_adam", "make_workspace", "move_target", "net_of", "parameters",
    "random_net", "td_update", "value_of", "zero_net",
]  # fmt: skip

TILE = 256
"""Head outputs at a time: 64 inputs by 256 outputs of float32 are 64 KB, near the core."""

ROWS = 4
"""Samples at a time in a product, as it is written out; a workspace has whole fours of rows."""


class Batch(NamedTuple):
    """B transitions, as in ``replay.Transitions``; the first ``experts`` of them are an expert's.

    ``first`` and ``last`` bound the feasible actions of the state, ``next_*`` of the next one.
    """

    inputs: Float32Array
    action: NDArray[np.int64]
    reward: Float32Array
    discount: Float32Array
    next_inputs: Float32Array
    first: NDArray[np.int16]
    last: NDArray[np.int16]
    next_first: NDArray[np.int16]
    next_last: NDArray[np.int16]
    experts: int


class Rule(NamedTuple):
    """How to update.

    Attributes:
        double: choose with the online net, evaluate with the target net.
        huber: Huber loss, else half the squared error.
        tanh: activation, else ReLU.
        margin: of the ordinal large-margin loss on experts' transitions, 0 for none: an action
            at distance d (share of the grid) must be worth ``margin * d`` less than the expert's.
            A flat margin would push 1599 nearly equal actions down.
    """

    double: bool
    huber: bool
    tanh: bool
    margin: float


class Workspace(NamedTuple):
    """Room for one batch, its rows rounded up to a multiple of ROWS.

    Attributes:
        layers, next_layers: activations in the state and the next one, input first, shape
            (layers, rows, largest width).
        slopes: the loss's slope in ``layers``.
        values, folded: action values of a tile, and room to search them.
        best, chosen: value and index of the best feasible action, shape (batch,).
    """

    layers: Float32Array
    next_layers: Float32Array
    slopes: Float32Array
    values: Float32Array
    folded: Float32Array
    best: Float32Array
    chosen: NDArray[np.int64]


def make_workspace(sizes: Sequence[int], batch: int) -> Workspace:
    """For batches of at most ``batch``."""
    rows = -(-batch // ROWS) * ROWS

    shape = (len(sizes) - 1, rows, max(sizes[:-1]))
    return Workspace(
        layers=np.zeros(shape, np.float32),
        next_layers=np.zeros(shape, np.float32),
        slopes=np.zeros(shape, np.float32),
        values=np.zeros((rows, TILE), np.float32),
        folded=np.zeros(TILE, np.float32),
        best=np.zeros(batch, np.float32),
        chosen=np.zeros(batch, np.int64),
    )


@njit(cache=True, error_model="numpy", fastmath=FAST)
def td_update(
    online: QNet,
    target: QNet,
    adam: Adam,
    work: Workspace,
    batch: Batch,
    rule: Rule,
    learning_rate: float,
    step: int,
) -> tuple[float, float]:
    """One gradient step of ``online``, in place.

    Args:
        step: number of this update, from 1: Adam's bias correction needs it.

    Returns:
        Mean loss (temporal difference and margin) and mean Q of the batch.
    """
    size = len(batch.action)
    share = np.float32(1.0 / size)

    # y of every transition: its greedy next action, evaluated by the target net.
    chooser = online if rule.double else target
    forward(chooser, batch.next_inputs, work.next_layers, rule.tanh)
    best_actions(chooser, work.next_layers[-1], batch.next_first, batch.next_last, size, work)
    if rule.double:
        forward(target, batch.next_inputs, work.next_layers, rule.tanh)
        for b in range(size):
            work.best[b] = value_of(target, work.next_layers[-1], b, work.chosen[b])

    # Gradient of the loss at the action taken; the rest of the head has none.
    forward(online, batch.inputs, work.layers, rule.tanh)
    hidden, slope = work.layers[-1], work.slopes[-1]
    slope[:] = np.float32(0.0)
    loss, mean_q = 0.0, 0.0
    for b in range(size):
        q = value_of(online, hidden, b, batch.action[b])
        error = q - (batch.reward[b] + batch.discount[b] * work.best[b])
        if not rule.huber or abs(error) <= 1.0:
            loss += 0.5 * error * error
        else:
            loss += abs(error) - 0.5
            error = np.float32(1.0) if error > 0.0 else np.float32(-1.0)
        mean_q += q
        _pull(online, adam.gradient, hidden, slope, b, batch.action[b], error * share)
    if rule.margin > 0.0 and batch.experts > 0:
        loss += _margin_loss(online, adam.gradient, hidden, slope, work, batch, rule.margin)
    backward(online, adam.gradient, work, batch.inputs, size, rule.tanh)
    adam_step(online.flat, adam, learning_rate, step)
    return loss / size, mean_q / size


@njit(cache=True, error_model="numpy", fastmath=FAST)
def forward(net: QNet, inputs: Float32Array, layers: Float32Array, tanh: bool) -> None:
    """Fill ``layers``: the inputs, then every hidden layer's activations."""
    size = len(inputs)
    for b in range(size):
        for i in range(inputs.shape[1]):
            layers[0][b, i] = inputs[b, i]
    for n in range(len(layers) - 1):
        weight, bias = layer(net, n)
        here, width = layers[n + 1], len(bias)
        for block in range(0, size, ROWS):
            _affine(weight, bias, layers[n], block, 0, width, here)
        for b in range(size):
            row = here[b]
            for j in range(width):
                row[j] = np.tanh(row[j]) if tanh else max(row[j], np.float32(0.0))


@njit(cache=True, error_model="numpy", fastmath=FAST)
def best_actions(
    net: QNet,
    hidden: Float32Array,
    first: NDArray[np.int16],
    last: NDArray[np.int16],
    size: int,
    work: Workspace,
) -> None:
    """Fill ``work.chosen`` and ``work.best`` with the best feasible action and its value; of
    equal ones the first."""
    _search(net, hidden, first, last, size, work, work.chosen, 0.0)


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _search(
    net: QNet,
    hidden: Float32Array,
    first: NDArray[np.int16],
    last: NDArray[np.int16],
    size: int,
    work: Workspace,
    origin: NDArray[np.int64],
    rise: float,
) -> None:
    """:func:`best_actions` of Q(s_b, a) + rise |a - origin_b|."""
    (weight, bias), values = head(net), work.values
    slant = np.float32(rise)
    for b in range(size):
        work.best[b] = -np.inf
        work.chosen[b] = first[b]
    for begin in range(0, weight.shape[1], TILE):
        end = min(begin + TILE, weight.shape[1])
        for block in range(0, size, ROWS):
            rows = range(block, min(block + ROWS, size))
            low, high = end, begin
            for b in rows:
                low, high = min(low, int(first[b])), max(high, int(last[b]) + 1)
            low, high = max(low, begin), min(high, end)
            if low >= high:
                continue
            _affine(weight, bias, hidden, block, low, high, values)
            for b in rows:
                start, stop = max(low, int(first[b])) - low, min(high, int(last[b]) + 1) - low
                if start >= stop:
                    continue
                row = values[b]
                if rise > 0.0:
                    for j in range(high - low):
                        row[j] += slant * np.float32(abs(low + j - origin[b]))
                most = _largest(row, start, stop, work.folded)
                if most > work.best[b]:
                    while row[start] != most:
                        start += 1
                    work.best[b] = most
                    work.chosen[b] = low + start


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _largest(row: Float32Array, begin: int, end: int, folded: Float32Array) -> float:
    """Largest of row[begin:end], by halving: one running maximum would not be vectorised."""
    begin, count = max(begin, 0), end - begin
    half = (count + 1) // 2
    for j in range(half):
        folded[j] = max(row[begin + j], row[begin + count - half + j])
    while half > 8:
        count, half = half, (half + 1) // 2
        for j in range(count - half):
            folded[j] = max(folded[j], folded[half + j])
    most = folded[0]
    for j in range(1, half):
        most = max(most, folded[j])
    return float(most)


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _affine(
    weight: Float32Array,
    bias: Float32Array,
    hidden: Float32Array,
    block: int,
    low: int,
    high: int,
    out: Float32Array,
) -> None:
    """out[b, :high - low] = outputs low..high - 1 of the ROWS samples b from ``block`` on.

    Four samples share every weight that is loaded, and four inputs every value that is stored.
    """
    begin, block = max(low, 0), max(block, 0)  # what might be negative is not vectorised
    count, width = high - begin, weight.shape[0]
    out0, out1, out2, out3 = out[block], out[block + 1], out[block + 2], out[block + 3]
    in0, in1, in2, in3 = hidden[block], hidden[block + 1], hidden[block + 2], hidden[block + 3]
    for j in range(count):
        out0[j] = out1[j] = out2[j] = out3[j] = bias[begin + j]
    whole = width - width % 4
    for i in range(0, whole, 4):
        a0, a1, a2, a3 = in0[i], in0[i + 1], in0[i + 2], in0[i + 3]
        b0, b1, b2, b3 = in1[i], in1[i + 1], in1[i + 2], in1[i + 3]
        c0, c1, c2, c3 = in2[i], in2[i + 1], in2[i + 2], in2[i + 3]
        d0, d1, d2, d3 = in3[i], in3[i + 1], in3[i + 2], in3[i + 3]
        for j in range(count):
            k = begin + j
            w0, w1, w2, w3 = weight[i, k], weight[i + 1, k], weight[i + 2, k], weight[i + 3, k]
            out0[j] += a0 * w0 + a1 * w1 + a2 * w2 + a3 * w3
            out1[j] += b0 * w0 + b1 * w1 + b2 * w2 + b3 * w3
            out2[j] += c0 * w0 + c1 * w1 + c2 * w2 + c3 * w3
            out3[j] += d0 * w0 + d1 * w1 + d2 * w2 + d3 * w3
    for i in range(whole, width):
        a0, b0, c0, d0 = in0[i], in1[i], in2[i], in3[i]
        for j in range(count):
            w0 = weight[i, begin + j]
            out0[j] += a0 * w0
            out1[j] += b0 * w0
            out2[j] += c0 * w0
            out3[j] += d0 * w0


@njit(cache=True, error_model="numpy", fastmath=FAST)
def value_of(net: QNet, hidden: Float32Array, b: int, action: int) -> float:
    """Q of one action, without the others."""
    weight, bias = head(net)
    total = bias[action]
    for i in range(weight.shape[0]):
        total += hidden[b, i] * weight[i, action]
    return float(total)


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _pull(
    net: QNet,
    gradient: QNet,
    hidden: Float32Array,
    slope: Float32Array,
    b: int,
    action: int,
    amount: float,
) -> None:
    """Add the gradient of ``amount * Q(s_b, action)`` at the head, and below it to ``slope``."""
    weight, _ = head(net)
    into, into_bias = head(gradient)
    into_bias[action] += amount
    for i in range(weight.shape[0]):
        into[i, action] += amount * hidden[b, i]
        slope[b, i] += amount * weight[i, action]


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _margin_loss(
    net: QNet,
    gradient: QNet,
    hidden: Float32Array,
    slope: Float32Array,
    work: Workspace,
    batch: Batch,
    margin: float,
) -> float:
    """max_a [Q(s, a) + margin |a - a_E| / A] - Q(s, a_E) over the experts' transitions."""
    total, share = 0.0, np.float32(1.0 / len(batch.action))
    rise = margin / net.sizes[-1]
    _search(net, hidden, batch.first, batch.last, batch.experts, work, batch.action, rise)
    for b in range(batch.experts):
        expert, rival = batch.action[b], work.chosen[b]
        excess = work.best[b] - value_of(net, hidden, b, expert)
        if rival != expert and excess > 0.0:
            total += excess
            _pull(net, gradient, hidden, slope, b, rival, float(share))
            _pull(net, gradient, hidden, slope, b, expert, -float(share))
    return total


@njit(cache=True, error_model="numpy", fastmath=FAST)
def backward(
    net: QNet, gradient: QNet, work: Workspace, inputs: Float32Array, size: int, tanh: bool
) -> None:
    """From ``work.slopes[-1]``, the loss's slope in the last hidden layer, down to the inputs.

    Slopes of the rows beyond ``size`` must be zero."""
    one, zero = np.float32(1.0), np.float32(0.0)
    for n in range(len(work.layers) - 2, -1, -1):
        below, here = work.layers[n], work.layers[n + 1]
        slope, slope_below = work.slopes[n + 1], work.slopes[n]
        weight, _ = layer(net, n)
        into, into_bias = layer(gradient, n)
        width = len(into_bias)
        for b in range(size):
            row, active = slope[b], here[b]
            for j in range(width):
                h = active[j]
                row[j] *= (one - h * h) if tanh else (one if h > zero else zero)
                into_bias[j] += row[j]
        for b in range(0, size, ROWS):
            s0, s1, s2, s3 = slope[b], slope[b + 1], slope[b + 2], slope[b + 3]
            for i in range(weight.shape[0]):
                x0, x1, x2, x3 = below[b, i], below[b + 1, i], below[b + 2, i], below[b + 3, i]
                t0, t1, t2, t3 = zero, zero, zero, zero
                w, g = weight[i], into[i]
                for j in range(width):
                    g[j] += x0 * s0[j] + x1 * s1[j] + x2 * s2[j] + x3 * s3[j]
                    t0 += w[j] * s0[j]
                    t1 += w[j] * s1[j]
                    t2 += w[j] * s2[j]
                    t3 += w[j] * s3[j]
                slope_below[b, i], slope_below[b + 1, i] = t0, t1
                slope_below[b + 2, i], slope_below[b + 3, i] = t2, t3
