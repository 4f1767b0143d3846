"""DQN that learns by driving, the paper's way: episodes, replay and updates in one compiled loop.

Plant and rewards are ``mdp``, the update is ``dqn_kernel``; what is here is who meets whom.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from tractor_ems.learning.dqn_kernel import (
    FAST,
    Adam,
    Batch,
    QNet,
    Rule,
    Workspace,
    best_actions,
    forward,
    make_adam,
    make_workspace,
    move_target,
    random_net,
    td_update,
    zero_net,
)
from tractor_ems.learning.mdp import (
    GreedyEpisode,
    Mdp,
    advance,
    battery_power_w,
    bounds_w,
    feasible_actions,
    reward_of,
)
from tractor_ems.learning.replay import Replay, Transitions
from tractor_ems.policies.mlp import Float32Array
from tractor_msgs_py.errors import RunAborted
from tractor_msgs_py.trajectory import FloatArray, IntArray

INPUTS = 2
"""The paper's state: power demand and SOC."""


class Encoder(NamedTuple):
    """How [P_dem, SOC] enters the network: (P - offset) / scale, and SOC from -1 to 1 over the
    window, in ``soc_bins`` steps where that is above 0. SOC is first rounded to float32, as the
    wire does."""

    demand_offset_w: float
    demand_scale_w: float
    soc_low: float
    soc_high: float
    soc_bins: int


class Store(NamedTuple):
    """The columns of a ``Replay`` and its [size, next], for compiled code to write to."""

    inputs: Float32Array
    action: NDArray[np.int64]
    reward: Float32Array
    discount: Float32Array
    next_inputs: Float32Array
    first: NDArray[np.int16]
    last: NDArray[np.int16]
    next_first: NDArray[np.int16]
    next_last: NDArray[np.int16]
    cursor: IntArray


class Pace(NamedTuple):
    """When to update.

    Attributes:
        gamma: discount per step.
        learning_rate: of Adam.
        steps_per_update: environment steps per gradient step.
        warm_up: transitions in the replay before the first update.
        target_every, target_rate: the target net moves by ``target_rate`` every so many updates;
            rate 1 is a hard copy.
    """

    gamma: float
    learning_rate: float
    steps_per_update: int
    warm_up: int
    target_every: int
    target_rate: float


@dataclass(frozen=True)
class OnlineAgent:
    """Everything of one run that changes, in arrays that are updated in place.

    Attributes:
        online, target, adam: the networks and the optimiser.
        replay: what was driven, and seeds in ``fifo`` mode; demonstrations: seeds that are kept,
            of capacity 1 and empty without them.
        progress: [environment steps, updates], int64.
        work, single, batch: room for the arithmetic, no state.
    """

    online: QNet
    target: QNet
    adam: Adam
    replay: Replay
    demonstrations: Replay
    progress: IntArray
    work: Workspace
    single: Workspace
    batch: Batch


def make_encoder(mdp: Mdp, soc_bins: int | None) -> Encoder:
    """Scaling from the cycle's own mean and spread (at least 1 kW), and the plant's SOC window."""
    demand_w = mdp.power_demand_w
    spread_w = max(float(demand_w.std()), 1e3)
    return Encoder(float(demand_w.mean()), spread_w, mdp.soc_min, mdp.soc_max, soc_bins or 0)


def make_agent(
    mdp: Mdp,
    hidden: tuple[int, ...],
    rng: np.random.Generator,
    *,
    batch: int,
    capacity: int,
    demonstrations: Transitions | None = None,
) -> OnlineAgent:
    """An agent at step 0; its weights are drawn from ``rng``.

    Args:
        hidden: widths of the hidden layers.
        batch: transitions per update, even.
        capacity: of the replay.
        demonstrations: transitions to keep beside the replay.
    """
    sizes = (INPUTS, *hidden, len(mdp.action_power_w))
    online, target = random_net(sizes, rng), zero_net(sizes)
    move_target(target, online, 1.0)
    kept = Replay(max(len(demonstrations) if demonstrations is not None else 0, 1), INPUTS)
    if demonstrations is not None:
        kept.add(demonstrations)
    return OnlineAgent(
        online=online,
        target=target,
        adam=make_adam(sizes),
        replay=Replay(capacity, INPUTS),
        demonstrations=kept,
        progress=np.zeros(2, np.int64),
        work=make_workspace(sizes, batch),
        single=make_workspace(sizes, 1),
        batch=_empty_batch(batch),
    )


def train_episodes(
    agent: OnlineAgent,
    mdp: Mdp,
    encoder: Encoder,
    epsilon: FloatArray,
    rng: np.random.Generator,
    pace: Pace,
    rule: Rule,
) -> FloatArray:
    """Drive and learn, one episode per entry of ``epsilon``; returns their sums of rewards, (E,).

    The end of the cycle is a truncation: the last step has no successor and is not stored.

    Raises:
        RunAborted: the loss is not finite any more.
    """
    replay, kept = agent.replay, agent.demonstrations
    store = _store(replay)
    returns, loss = _train_episodes(
        mdp,
        encoder,
        agent.online,
        agent.target,
        agent.adam,
        agent.work,
        agent.single,
        agent.batch,
        store,
        _store(kept),
        epsilon,
        rng,
        pace,
        rule,
        agent.progress,
    )
    replay.size, replay.next = (int(value) for value in store.cursor)
    if not np.isfinite(loss):
        raise RunAborted(f"training diverged by update {agent.progress[1]}: the loss is {loss}")
    return returns


def greedy_episode(
    agent: OnlineAgent, mdp: Mdp, encoder: Encoder, *, tanh: bool = False
) -> GreedyEpisode:
    """Drive the cycle once without exploration or learning."""
    return _greedy_episode(mdp, encoder, agent.online, agent.single, tanh)


def encode_trace(encoder: Encoder, power_demand_w: FloatArray, soc: FloatArray) -> Float32Array:
    """Network inputs of recorded states, shape (N, 2)."""
    inputs = np.zeros((len(soc), INPUTS), np.float32)
    _encode_all(encoder, power_demand_w, soc, inputs)
    return inputs


def agent_tensors(agent: OnlineAgent) -> dict[str, Any]:
    """All state but generators, for a checkpoint. Demonstrations are made anew from their bags."""
    return {
        "online": agent.online.flat,
        "target": agent.target.flat,
        "adam.mean": agent.adam.mean,
        "adam.square": agent.adam.square,
        "progress": agent.progress,
        "cursor": np.array([agent.replay.size, agent.replay.next], np.int64),
        **agent.replay.tensors(),
    }


def restore_agent(agent: OnlineAgent, tensors: dict[str, Any]) -> None:
    """Inverse of :func:`agent_tensors`."""
    agent.online.flat[:] = tensors["online"]
    agent.target.flat[:] = tensors["target"]
    agent.adam.mean[:] = tensors["adam.mean"]
    agent.adam.square[:] = tensors["adam.square"]
    agent.progress[:] = tensors["progress"]
    size, following = (int(value) for value in tensors["cursor"])
    agent.replay.restore(tensors, size, following)


def _store(replay: Replay) -> Store:
    cursor = np.array([replay.size, replay.next], np.int64)
    return Store(**replay.columns, cursor=cursor)


def _empty_batch(size: int) -> Batch:
    return Batch(**Replay(size, INPUTS).columns, experts=0)


@njit(cache=True, error_model="numpy")
def _encode(encoder: Encoder, demand_w: float, soc: float, row: Float32Array) -> None:
    seen = np.float64(np.float32(soc))
    share = (seen - encoder.soc_low) / (encoder.soc_high - encoder.soc_low)
    if encoder.soc_bins > 0:
        bins = encoder.soc_bins
        share = (min(max(np.floor(share * bins), 0.0), bins - 1.0) + 0.5) / bins
    row[0] = (demand_w - encoder.demand_offset_w) / encoder.demand_scale_w
    row[1] = 2.0 * share - 1.0


@njit(cache=True, error_model="numpy")
def _encode_all(
    encoder: Encoder, power_demand_w: FloatArray, soc: FloatArray, inputs: Float32Array
) -> None:
    for k in range(len(soc)):
        _encode(encoder, power_demand_w[k], soc[k], inputs[k])


@njit(cache=True, error_model="numpy")
def _greedy(
    net: QNet, single: Workspace, row: Float32Array, first: int, last: int, tanh: bool
) -> int:
    bounds = np.array([first, last], np.int16)
    forward(net, row.reshape(1, -1), single.layers, tanh)
    best_actions(net, single.layers[-1], bounds[:1], bounds[1:], 1, single)
    return int(single.chosen[0])


@njit(cache=True, error_model="numpy")
def _copy(batch: Batch, b: int, store: Store, n: int) -> None:
    batch.inputs[b] = store.inputs[n]
    batch.next_inputs[b] = store.next_inputs[n]
    batch.action[b] = store.action[n]
    batch.reward[b] = store.reward[n]
    batch.discount[b] = store.discount[n]
    batch.first[b] = store.first[n]
    batch.last[b] = store.last[n]
    batch.next_first[b] = store.next_first[n]
    batch.next_last[b] = store.next_last[n]


@njit(cache=True, error_model="numpy")
def _draw(batch: Batch, begin: int, end: int, store: Store, rng: np.random.Generator) -> None:
    """Uniformly with replacement."""
    for b in range(begin, end):
        _copy(batch, b, store, int(rng.random() * store.cursor[0]))


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _train_episodes(
    mdp: Mdp,
    encoder: Encoder,
    online: QNet,
    target: QNet,
    adam: Adam,
    work: Workspace,
    single: Workspace,
    room: Batch,
    store: Store,
    kept: Store,
    epsilon: FloatArray,
    rng: np.random.Generator,
    pace: Pace,
    rule: Rule,
    progress: IntArray,
) -> tuple[FloatArray, float]:
    demand_w, size = mdp.power_demand_w, len(room.action)
    experts = size // 2 if kept.cursor[0] > 0 else 0
    batch = Batch(
        room.inputs,
        room.action,
        room.reward,
        room.discount,
        room.next_inputs,
        room.first,
        room.last,
        room.next_first,
        room.next_last,
        experts,
    )
    here, ahead = np.zeros(2, np.float32), np.zeros(2, np.float32)
    capacity, cursor = len(store.action), store.cursor
    returns, loss = np.zeros(len(epsilon)), 0.0
    for e in range(len(epsilon)):
        soc = mdp.soc_initial
        lb, ub = bounds_w(mdp, demand_w[0], soc)
        first, last = feasible_actions(mdp, demand_w[0], lb, ub)
        _encode(encoder, demand_w[0], soc, here)
        for k in range(len(demand_w)):
            if rng.random() < epsilon[e]:
                action = first + int(rng.random() * (last - first + 1))
            else:
                action = _greedy(online, single, here, first, last, rule.tanh)
            wanted_w = battery_power_w(mdp, action, demand_w[k], lb, ub)
            soc_next, engine_w, fuel_kg = advance(mdp, demand_w[k], soc, wanted_w)
            reward = reward_of(mdp, engine_w, fuel_kg, soc, soc_next)
            returns[e] += reward
            soc = soc_next
            if k + 1 < len(demand_w):
                n = cursor[1]
                store.inputs[n] = here
                store.action[n] = action
                store.reward[n] = reward
                store.discount[n] = pace.gamma
                store.first[n], store.last[n] = first, last
                lb, ub = bounds_w(mdp, demand_w[k + 1], soc)
                first, last = feasible_actions(mdp, demand_w[k + 1], lb, ub)
                _encode(encoder, demand_w[k + 1], soc, ahead)
                store.next_inputs[n] = ahead
                store.next_first[n], store.next_last[n] = first, last
                here[:] = ahead
                cursor[1] = (n + 1) % capacity
                cursor[0] = min(cursor[0] + 1, capacity)
            progress[0] += 1
            if progress[0] % pace.steps_per_update == 0 and cursor[0] >= pace.warm_up:
                _draw(batch, 0, experts, kept, rng)
                _draw(batch, experts, size, store, rng)
                progress[1] += 1
                loss, _ = td_update(
                    online, target, adam, work, batch, rule, pace.learning_rate, progress[1]
                )
                if progress[1] % pace.target_every == 0:
                    move_target(target, online, pace.target_rate)
    return returns, loss


@njit(cache=True, error_model="numpy")
def _greedy_episode(
    mdp: Mdp, encoder: Encoder, net: QNet, single: Workspace, tanh: bool
) -> GreedyEpisode:
    demand_w = mdp.power_demand_w
    steps = len(demand_w)
    battery_w, engine_w, fuel_kg = np.zeros(steps), np.zeros(steps), np.zeros(steps)
    reward, soc, row = np.zeros(steps), np.zeros(steps + 1), np.zeros(2, np.float32)
    soc[0] = mdp.soc_initial
    for k in range(steps):
        lb, ub = bounds_w(mdp, demand_w[k], soc[k])
        first, last = feasible_actions(mdp, demand_w[k], lb, ub)
        _encode(encoder, demand_w[k], soc[k], row)
        action = _greedy(net, single, row, first, last, tanh)
        battery_w[k] = battery_power_w(mdp, action, demand_w[k], lb, ub)
        soc[k + 1], engine_w[k], fuel_kg[k] = advance(mdp, demand_w[k], soc[k], battery_w[k])
        reward[k] = reward_of(mdp, engine_w[k], fuel_kg[k], soc[k], soc[k + 1])
    return GreedyEpisode(battery_w, engine_w, fuel_kg, reward, soc)
