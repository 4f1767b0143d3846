"""How fast the agents learn on this machine: CPU time of one thread, measured when asked.

Runs of a study overlap and share the machine, so their wall time says little about the code.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from tractor_ems.learning import tabular
from tractor_ems.learning.dqn_kernel import Rule
from tractor_ems.learning.online import Pace, make_agent, make_encoder, train_episodes
from tractor_ems.study.config import StudyConfig
from tractor_ems.study.rows import Row
from tractor_ems.study.run import process_of

TABLE_EPISODES, NETWORK_EPISODES = 200, 8
"""Enough for a second or so each, after a first piece that compiles."""


@dataclass(frozen=True)
class Speed:
    """One measurement: what ran, how many per second of CPU time, and of what."""

    what: str
    per_s: float
    unit: str

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return dict(vars(self))


def measure(config: StudyConfig) -> list[Speed]:
    """Plain, double and interpolated tables, and networks with one update per four steps."""
    rows = {row.id: row for row in config.rows}
    found: list[Speed] = []
    for name in ("q", "double_q", "double_q_interpolated"):
        if name in rows:
            found.append(_table(config, rows[name]))
    for name in ("ddqn", "ddqn_fuel_knots"):
        if name in rows:
            found += _network(config, rows[name])
    return found


def _table(config: StudyConfig, row: Row) -> Speed:
    mdp, settings = process_of(config, row), config.tables
    agent = tabular.make_agent(
        mdp,
        double=row.algorithm == "double_q",
        soc_bins=settings.soc_bins,
        demand_bins=settings.demand_bins,
        interpolate=row.interpolate,
    )
    rng = np.random.default_rng(0)

    def drive(episodes: int) -> None:
        epsilon = np.linspace(1.0, settings.epsilon_end, episodes)
        tabular.train_episodes(
            agent, mdp, epsilon, rng, gamma=settings.gamma, alpha=settings.alpha
        )

    seconds = _cpu_s(drive, TABLE_EPISODES)
    return Speed(row.label, TABLE_EPISODES * len(mdp.power_demand_w) / seconds, "transitions")


def _network(config: StudyConfig, row: Row) -> list[Speed]:
    """Transitions that were replayed, and updates; driving and sampling included."""
    mdp, settings = process_of(config, row), config.networks
    rng, encoder = np.random.default_rng(0), make_encoder(mdp, row.soc_bins)
    agent = make_agent(mdp, settings.hidden, rng, batch=settings.batch, capacity=20_000)
    pace = Pace(
        gamma=settings.gamma,
        learning_rate=settings.learning_rate,
        steps_per_update=4,
        warm_up=settings.batch,
        target_every=row.target_every,
        target_rate=row.target_rate,
    )
    rule = Rule(double=row.algorithm == "ddqn", huber=True, tanh=False, margin=0.0)

    def drive(episodes: int) -> None:
        epsilon = np.linspace(1.0, settings.epsilon_end, episodes)
        train_episodes(agent, mdp, encoder, epsilon, rng, pace, rule)

    drive(1)
    before = int(agent.progress[1])
    seconds = _cpu_s(drive, NETWORK_EPISODES, warm=False)
    updates = int(agent.progress[1]) - before
    what = f"{row.label}, {row.actions} actions"
    return [
        Speed(what, updates / seconds, "updates"),
        Speed(what, updates * settings.batch / seconds, "transitions"),
    ]


def _cpu_s(drive: Callable[[int], None], episodes: int, *, warm: bool = True) -> float:
    if warm:
        drive(1)
    began = time.process_time()
    drive(episodes)
    return time.process_time() - began
