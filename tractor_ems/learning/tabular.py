"""The paper's tabular agents: Q-learning and double Q-learning over SOC, demand and action bins.

The plant's SOC is continuous and only binned for look-up: one step moves it by some 9 % of
one of 50 bins at most, so snapping would freeze it. The loops are in ``tabular_kernel``.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from tractor_ems.learning import tabular_kernel as kernel
from tractor_ems.learning import tabular_pairs as pairs
from tractor_ems.learning.mdp import GreedyEpisode, Mdp
from tractor_ems.learning.tabular_pairs import Bits, Grid, Table
from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.trajectory import FloatArray, IntArray

DEFAULT_ALPHA = 0.1
"""Constant step size; the paper prints none for its tables."""

SAMPLE_PAIRS = 20_000

_GREEDY_TIES_SEED = 0


@dataclass(frozen=True)
class TabularAgent:
    """Tables and how to look up in them. The arrays change while training, nothing else does.

    Attributes:
        tables: one for Q-learning, two for double Q-learning, 0 where never updated; shape
            (1 or 2, soc_bins * demand_bins, actions), float32.
        visited: one bit per pair that was ever updated, in the order of a table, little-endian
            within a byte.
        state_visits: steps begun in every bin pair, shape (soc_bins, demand_bins).
        grid: the bins.
    """

    tables: Table
    visited: Bits
    state_visits: IntArray
    grid: Grid

    @property
    def double(self) -> bool:
        """Two tables."""
        return len(self.tables) == 2


@dataclass(frozen=True)
class TableStudy:
    """What a table looks like after training.

    Attributes:
        state_visits: visits of every (SOC bin, demand bin), shape (50, 766).
        pairs: entries of the table; pairs_feasible: those that the plant allows somewhere in
            their bin; pairs_visited: those updated at least once.
        pearson: correlation between Q and reward over visited pairs; None when undefined.
        sample_q, sample_reward: Q and reward of at most 20,000 visited pairs, for the picture.
        bytes: memory of the tables [B].
    """

    state_visits: IntArray
    pairs: int
    pairs_feasible: int
    pairs_visited: int
    pearson: float | None
    sample_q: FloatArray
    sample_reward: FloatArray
    bytes: int


def make_agent(
    mdp: Mdp,
    *,
    double: bool,
    soc_bins: int = 50,
    demand_bins: int = 766,
    interpolate: bool = False,
) -> TabularAgent:
    """Tables of zeros; memory is used from the first update of an entry's page on.

    Args:
        mdp: SOC bins share its window evenly, demand bins the range of its cycle.
        double: two tables.
        interpolate: read Q linearly between the two nearest SOC bin centres, constant beyond the
            outermost, and split updates by the same weights.

    Raises:
        ConfigError: fewer than one bin.
    """
    grid = _grid(mdp, soc_bins, demand_bins, interpolate)
    rows, actions = soc_bins * demand_bins, len(mdp.action_power_w)
    return TabularAgent(
        tables=np.zeros((2 if double else 1, rows, actions), dtype=np.float32),
        visited=np.zeros((rows * actions + 7) // 8, dtype=np.uint8),
        state_visits=np.zeros((soc_bins, demand_bins), dtype=np.int64),
        grid=grid,
    )


def train_episodes(
    agent: TabularAgent,
    mdp: Mdp,
    epsilon: FloatArray,
    rng: np.random.Generator,
    *,
    gamma: float,
    alpha: float = DEFAULT_ALPHA,
) -> FloatArray:
    """Drive and learn for E episodes, each from ``mdp.soc_initial``; changes the agent's arrays.

    Infeasible actions are neither tried, chosen nor bootstrapped from. The last step of a cycle
    has no successor (a truncation) and is not learnt from.

    Args:
        epsilon: probability of a random feasible action in every episode, shape (E,), 0..1.
        rng: decides everything random; its state moves on.
        gamma: discount, 0..1.
        alpha: step size, 0 < alpha <= 1.

    Returns:
        Undiscounted sum of rewards of every episode, exploration included, shape (E,).

    Raises:
        ConfigError: a number is out of range, or the agent was made for another process.
    """
    _check_agent(agent, mdp)
    rates = np.ascontiguousarray(epsilon, dtype=np.float64)
    if rates.ndim != 1 or not np.all((rates >= 0.0) & (rates <= 1.0)):
        raise ConfigError(f"epsilon: {epsilon}, allowed one value of 0..1 per episode")
    if not 0.0 <= gamma <= 1.0:
        raise ConfigError(f"gamma: {gamma}, allowed 0..1")
    if not 0.0 < alpha <= 1.0:
        raise ConfigError(f"alpha: {alpha}, allowed 0 < alpha <= 1")
    train_return = np.zeros(len(rates))
    kernel.train(
        agent.tables,
        agent.visited,
        agent.state_visits,
        agent.grid,
        mdp,
        rates,
        float(gamma),
        float(alpha),
        rng,
        train_return,
    )
    return train_return


def greedy_episode(agent: TabularAgent, mdp: Mdp) -> GreedyEpisode:
    """Drive the cycle once with the best action of the table, of the sum of two tables.

    Ties, for instance states that were never updated, are broken by a fixed stream of random
    numbers: the same tables always drive the same way.

    Raises:
        ConfigError: the agent was made for another process.
    """
    _check_agent(agent, mdp)
    steps = len(mdp.power_demand_w)
    asked_w, engine_w, fuel_kg, rewards = (np.zeros(steps) for _ in range(4))
    soc = np.zeros(steps + 1)
    ties = np.random.default_rng(_GREEDY_TIES_SEED)
    kernel.greedy(agent.tables, agent.grid, mdp, ties, asked_w, soc, engine_w, fuel_kg, rewards)
    return GreedyEpisode(asked_w, engine_w, fuel_kg, rewards, soc)


def table_study(agent: TabularAgent, mdp: Mdp, rng: np.random.Generator) -> TableStudy:
    """What the tables look like now.

    Q of a pair is the mean of two tables; its reward is that of the action at the centre of the
    pair's bins, clipped to what is feasible there. The Pearson coefficient is over all visited
    pairs, the sample of at most 20,000 is drawn evenly from them.

    Raises:
        ConfigError: the agent was made for another process.
    """
    _check_agent(agent, mdp)
    visited = pairs_visited(agent)
    size = min(visited, SAMPLE_PAIRS)
    ranks = np.sort(rng.choice(visited, size, replace=False, shuffle=False)).astype(np.int64)
    sample_q, sample_reward = np.zeros(size), np.zeros(size)
    square_q, square_r, product = pairs.correlate(
        agent.tables, agent.visited, agent.grid, mdp, ranks, sample_q, sample_reward
    )
    defined = visited > 1 and square_q > 0.0 and square_r > 0.0
    return TableStudy(
        state_visits=agent.state_visits.copy(),
        pairs=agent.tables[0].size,
        pairs_feasible=int(pairs.count_feasible(agent.grid, mdp)),
        pairs_visited=visited,
        pearson=float(product / np.sqrt(square_q) / np.sqrt(square_r)) if defined else None,
        sample_q=sample_q,
        sample_reward=sample_reward,
        bytes=agent.tables.nbytes + agent.visited.nbytes + agent.state_visits.nbytes,
    )


def pairs_visited(agent: TabularAgent) -> int:
    """Pairs that were ever updated."""
    return _bits(agent.visited)


def _bits(octets: Bits) -> int:
    """Bits that are set; numpy counts them itself from 2.0 on."""
    each = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1).sum(axis=1)
    return int(np.bincount(octets, minlength=256) @ each)


def sparse_state(agent: TabularAgent) -> dict[str, np.ndarray[Any, Any]]:
    """Everything that training changed, as arrays for a checkpoint: copies, and of the tables
    only the entries that were ever updated."""
    values = np.empty((len(agent.tables), pairs_visited(agent)), dtype=np.float32)
    pairs.gather(agent.tables, agent.visited, values)
    return {
        "visited": agent.visited.copy(),
        "values": values,
        "state_visits": agent.state_visits.copy(),
    }


def restore_state(agent: TabularAgent, tensors: Mapping[str, np.ndarray[Any, Any]]) -> None:
    """Bring the agent to the state that ``sparse_state`` saved; changes its arrays.

    Raises:
        ConfigError: the tensors are those of another shape of table.
    """
    own = _sparse_shapes(agent)
    for name, (shape, dtype) in own.items():
        value = tensors.get(name)
        if value is None or value.shape[: len(shape)] != shape or value.dtype != dtype:
            found = "missing" if value is None else f"{value.dtype} {value.shape}"
            raise ConfigError(f"checkpoint tensor {name}: {found}, allowed {dtype} {shape}")
    visited, values = tensors["visited"], tensors["values"]
    count = _bits(visited)
    if values.shape != (len(agent.tables), count):
        raise ConfigError(
            f"checkpoint tensor values: {values.shape}, allowed {(len(agent.tables), count)}"
        )
    # Zeros only where there was something: filling whole tables would use all their memory.
    pairs.scatter(
        agent.tables,
        agent.visited,
        np.zeros((len(agent.tables), pairs_visited(agent)), dtype=np.float32),
    )
    agent.visited[:] = visited
    agent.state_visits[:] = tensors["state_visits"]
    pairs.scatter(agent.tables, agent.visited, np.ascontiguousarray(values))


def _sparse_shapes(agent: TabularAgent) -> dict[str, tuple[tuple[int, ...], np.dtype[Any]]]:
    """Leading shape and type of every tensor of ``sparse_state``."""
    return {
        "visited": (agent.visited.shape, agent.visited.dtype),
        "values": ((len(agent.tables),), agent.tables.dtype),
        "state_visits": (agent.state_visits.shape, agent.state_visits.dtype),
    }


def _grid(mdp: Mdp, soc_bins: int, demand_bins: int, interpolate: bool) -> Grid:
    for name, value in (("soc_bins", soc_bins), ("demand_bins", demand_bins)):
        if value < 1:
            raise ConfigError(f"{name}: {value}, allowed >= 1")
    lowest_w, highest_w = float(mdp.power_demand_w.min()), float(mdp.power_demand_w.max())
    return Grid(
        soc_bins=int(soc_bins),
        demand_bins=int(demand_bins),
        soc_from=mdp.soc_min,
        soc_step=(mdp.soc_max - mdp.soc_min) / soc_bins,
        demand_from_w=lowest_w,
        demand_step_w=(highest_w - lowest_w) / demand_bins,
        interpolate=bool(interpolate),
    )


def _check_agent(agent: TabularAgent, mdp: Mdp) -> None:
    grid = agent.grid
    actions = len(mdp.action_power_w)
    if agent.tables.shape[2] != actions:
        raise ConfigError(
            f"agent: made for {agent.tables.shape[2]} actions, this process has {actions}"
        )
    if grid != _grid(mdp, grid.soc_bins, grid.demand_bins, grid.interpolate):
        raise ConfigError("agent: made for another SOC window or cycle than this process has")
