"""One run of the study: one agent, one seed, from nothing to a judged greedy policy.

A run is cut into pieces that end with a greedy evaluation. Between pieces it can be stopped, and
a run that goes on from its checkpoint ends with the same bytes as one that was never stopped.
"""

import hashlib
import json
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from tractor_ems.learning import tabular
from tractor_ems.learning.checkpoint import load_checkpoint, save_checkpoint
from tractor_ems.learning.dqn_kernel import Rule
from tractor_ems.learning.mdp import GreedyEpisode, Mdp, make_mdp
from tractor_ems.learning.online import (
    Pace,
    agent_tensors,
    greedy_episode,
    make_agent,
    make_encoder,
    restore_agent,
    train_episodes,
)
from tractor_ems.learning.replay import Seeding
from tractor_ems.learning.tabular import TableStudy
from tractor_ems.policies.protocol import ANY_RUN
from tractor_ems.study.baselines import outcome_of, reward_config
from tractor_ems.study.config import StudyConfig
from tractor_ems.study.experts import SEEDING, plant, seeds
from tractor_ems.study.results import Curve, Run
from tractor_ems.study.rows import Row
from tractor_ems.study.store import save_run
from tractor_msgs_py.errors import RunAborted
from tractor_msgs_py.observation import Observation, ObservationSpec
from tractor_msgs_py.trajectory import FloatArray, Trajectory
from tractor_sim.duty_cycle.cycle import cycle_hash
from tractor_sim.duty_cycle.library import load_cycle
from tractor_sim.powertrain import Command, PowertrainParams
from tractor_sim.powertrain_json import powertrain_hash

ALGORITHM = 1
"""Raise when the same settings give another result: cached runs are then made anew."""

CHECKPOINT_EVERY_S = 120.0

SOC_TOLERANCE = 1e-9


@dataclass(frozen=True)
class Task:
    """What to run, and where its files go (``store.run_folder``)."""

    config: StudyConfig
    row: Row
    seed: int
    folder: Path
    bags: Path


def config_hash(config: StudyConfig, row: Row, seed: int) -> str:
    """SHA-256 of everything that decides a run."""
    identity = {
        **config.identity(row),
        "algorithm": ALGORITHM,
        "seed": seed,
        "powertrain_hash": powertrain_hash(plant(config, row.soc_min)),
        "cycle_hash": cycle_hash(load_cycle(config.cycle)),
    }
    if row.seeding != "none":
        identity["seeding"] = SEEDING
    return hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()


def process_of(config: StudyConfig, row: Row) -> Mdp:
    """The decision process of a row: the study's cycle on its plant, in its reward."""
    params = plant(config, row.soc_min)
    return make_mdp(
        params,
        bus_demand_w(config, params),
        reward_config(row.reward),
        mapping=row.mapping,
        actions=row.actions,
        soc_initial=config.soc_initial,
        soc_target=config.soc_target,
    )


def bus_demand_w(config: StudyConfig, params: PowertrainParams) -> FloatArray:
    """Demand of the study's cycle at the bus, auxiliaries included, shape (T,) [W]."""
    return load_cycle(config.cycle).power_demand_w + params.p_aux_w


def execute(
    task: Task,
    *,
    report: Callable[[float], None] = lambda share: None,
    stop: Callable[[], bool] = lambda: False,
) -> Run | None:
    """Train, judge and save one run, from its checkpoint where there is one.

    Args:
        report: called with the share done, 0..1, after every piece.
        stop: asked after every piece; True leaves a checkpoint and returns None.

    Raises:
        RunAborted: the training diverged.
        BagError: demonstrations are missing or cannot be read.
    """
    config, row = task.config, task.row
    params = plant(config, row.soc_min)
    mdp = process_of(config, row)
    digest = config_hash(config, row, task.seed)
    trainer = _TableTrainer(task, mdp) if row.tabular else _NetworkTrainer(task, mdp)
    progress = _Progress()
    for left in task.folder.glob(".*.part"):  # of a process that was killed while it wrote
        left.unlink()
    checkpoint, identity = task.folder / "checkpoint.safetensors", {"config_hash": digest}
    if checkpoint.exists():
        tensors, state = load_checkpoint(checkpoint, identity)
        trainer.restore(tensors, state["rng"])
        progress = _Progress.of(tensors, state["seconds"])
    began = saved = time.monotonic()
    epsilon, every = trainer.epsilon, trainer.eval_every
    if not progress.episode:
        progress.evaluate(0, trainer.greedy())
    while progress.done < len(epsilon):
        piece = epsilon[progress.done : progress.done + every]
        progress.train_return.append(trainer.train(piece))
        progress.evaluate(progress.done, trainer.greedy())
        report(progress.done / len(epsilon))
        now, stopped = time.monotonic(), stop()
        if progress.done < len(epsilon) and (stopped or now - saved > CHECKPOINT_EVERY_S):
            saved = now
            spent = progress.seconds + now - began
            state = {"rng": trainer.rng.bit_generator.state, "seconds": spent}
            save_checkpoint(
                checkpoint, {**trainer.tensors(), **progress.tensors()}, state, identity
            )
            if stopped:
                return None
    seconds = progress.seconds + time.monotonic() - began
    trajectory = drive_again(trainer.greedy(), params, mdp.power_demand_w, config)
    run = Run(
        row=row,
        seed=task.seed,
        config_hash=digest,
        episodes=progress.done,
        steps=progress.done * len(mdp.power_demand_w),
        updates=trainer.updates(progress.done),
        curve=progress.curve(),
        outcome=outcome_of(
            trajectory, params, reward_config(row.reward), soc_target=config.soc_target
        ),
        seeding={name: vars(part) for name, part in trainer.seeding.items()},
        table=trainer.table(),
        seconds=seconds,
        peak_rss_bytes=_peak_rss_bytes(),
    )
    if not np.isfinite([run.outcome.fuel_kg, run.outcome.reward_sum]).all():
        raise RunAborted(f"{row.key} seed {task.seed}: fuel or sum of rewards is not finite")
    save_run(task.folder, run)
    checkpoint.unlink(missing_ok=True)
    return run


@dataclass
class _Progress:
    """Curves as they grow."""

    train_return: list[FloatArray] = field(default_factory=list)
    episode: list[int] = field(default_factory=list)
    returns: list[float] = field(default_factory=list)
    fuel_kg: list[float] = field(default_factory=list)
    soc_final: list[float] = field(default_factory=list)
    seconds: float = 0.0

    @property
    def done(self) -> int:
        return sum(len(part) for part in self.train_return)

    def evaluate(self, episode: int, greedy: GreedyEpisode) -> None:
        self.episode.append(episode)
        self.returns.append(float(greedy.reward.sum()))
        self.fuel_kg.append(float(greedy.fuel_kg.sum()))
        self.soc_final.append(float(greedy.soc[-1]))

    def curve(self) -> Curve:
        return Curve(
            train_return=np.concatenate([np.zeros(0), *self.train_return]),
            episode=np.array(self.episode, np.int64),
            eval_return=np.array(self.returns),
            eval_fuel_kg=np.array(self.fuel_kg),
            eval_soc_final=np.array(self.soc_final),
        )

    def tensors(self) -> dict[str, Any]:
        return {f"curve.{name}": value for name, value in vars(self.curve()).items()}

    @staticmethod
    def of(tensors: dict[str, Any], seconds: float) -> "_Progress":
        return _Progress(
            [tensors["curve.train_return"]],
            tensors["curve.episode"].tolist(),
            tensors["curve.eval_return"].tolist(),
            tensors["curve.eval_fuel_kg"].tolist(),
            tensors["curve.eval_soc_final"].tolist(),
            seconds,
        )


def epsilon_schedule(start: float, end: float, share: float, episodes: int) -> FloatArray:
    """Exploration of every episode: linear from ``start`` to ``end`` over ``share`` of them."""
    fallen = np.minimum(np.arange(episodes) / max(share * episodes, 1.0), 1.0)
    return start + (min(end, start) - start) * fallen


class _NetworkTrainer:
    """DQN and double DQN."""

    def __init__(self, task: Task, mdp: Mdp) -> None:
        config, row, budget = task.config, task.row, task.config.budget
        settings = config.networks
        init, seeding, self.rng = _generators(task.seed)
        self.mdp, self.encoder = mdp, make_encoder(mdp, row.soc_bins)
        drawn, self.seeding = (None, dict[str, Seeding]())
        if row.seeding != "none":
            drawn, found = seeds(row, config, task.bags, mdp, self.encoder, seeding)
            self.seeding = dict(found)
        kept = drawn if row.replay == "kept" else None
        self.agent = make_agent(
            mdp,
            settings.hidden,
            init,
            batch=settings.batch,
            capacity=config.replay_capacity,
            demonstrations=kept,
        )
        if drawn is not None and kept is None:
            self.agent.replay.add(drawn)
        self.pace = Pace(
            gamma=settings.gamma,
            learning_rate=settings.learning_rate,
            steps_per_update=budget.steps_per_update,
            warm_up=settings.warm_up,
            target_every=row.target_every,
            target_rate=row.target_rate,
        )
        self.rule = Rule(double=row.algorithm == "ddqn", huber=True, tanh=False, margin=row.margin)
        self.eval_every = budget.network_eval_every
        self.epsilon = epsilon_schedule(
            row.epsilon_start,
            settings.epsilon_end,
            settings.epsilon_decay_share,
            budget.network_episodes,
        )

    def train(self, epsilon: FloatArray) -> FloatArray:
        return train_episodes(
            self.agent, self.mdp, self.encoder, epsilon, self.rng, self.pace, self.rule
        )

    def greedy(self) -> GreedyEpisode:
        return greedy_episode(self.agent, self.mdp, self.encoder, tanh=self.rule.tanh)

    def updates(self, episodes: int) -> int:
        return int(self.agent.progress[1])

    def table(self) -> TableStudy | None:
        return None

    def tensors(self) -> dict[str, Any]:
        return agent_tensors(self.agent)

    def restore(self, tensors: dict[str, Any], rng: dict[str, Any]) -> None:
        restore_agent(self.agent, tensors)
        self.rng.bit_generator.state = rng


class _TableTrainer:
    """Q-learning and double Q-learning."""

    seeding: dict[str, Seeding] = {}  # noqa: RUF012  (a table has no replay)

    def __init__(self, task: Task, mdp: Mdp) -> None:
        row, budget, self.settings = task.row, task.config.budget, task.config.tables
        _, self.sample_rng, self.rng = _generators(task.seed)
        self.mdp = mdp
        self.agent = tabular.make_agent(
            mdp,
            double=row.algorithm == "double_q",
            soc_bins=self.settings.soc_bins,
            demand_bins=self.settings.demand_bins,
            interpolate=row.interpolate,
        )
        self.eval_every = budget.table_eval_every
        self.epsilon = epsilon_schedule(
            row.epsilon_start,
            self.settings.epsilon_end,
            self.settings.epsilon_decay_share,
            budget.table_episodes,
        )

    def train(self, epsilon: FloatArray) -> FloatArray:
        return tabular.train_episodes(
            self.agent,
            self.mdp,
            epsilon,
            self.rng,
            gamma=self.settings.gamma,
            alpha=self.settings.alpha,
        )

    def greedy(self) -> GreedyEpisode:
        return tabular.greedy_episode(self.agent, self.mdp)

    def updates(self, episodes: int) -> int:
        return episodes * (len(self.mdp.power_demand_w) - 1)

    def table(self) -> TableStudy | None:
        return tabular.table_study(self.agent, self.mdp, self.sample_rng)

    def tensors(self) -> dict[str, Any]:
        return tabular.sparse_state(self.agent)

    def restore(self, tensors: dict[str, Any], rng: dict[str, Any]) -> None:
        tabular.restore_state(self.agent, tensors)
        self.rng.bit_generator.state = rng


@dataclass(frozen=True)
class _Replayed:
    """Plays back the commands of a greedy episode, so that the production plant has the word."""

    episode: GreedyEpisode
    name: str = "study_agent"
    spec: ObservationSpec = ANY_RUN

    def init(self, batch: int) -> int:
        return 0

    def act(self, observation: Observation, state: int) -> tuple[Command, int]:
        off = self.episode.engine_power_w[state] == 0.0
        return Command(
            self.episode.battery_power_w[state : state + 1], np.array([0.0 if off else np.nan])
        ), state + 1


def drive_again(
    episode: GreedyEpisode, params: PowertrainParams, demand_w: FloatArray, config: StudyConfig
) -> Trajectory:
    """The greedy episode on the production plant.

    Raises:
        RunAborted: it goes another way there, so the compiled plant is not the production one.
    """
    from tractor_ems.drive import drive

    trajectory = drive(
        _Replayed(episode), params, demand_w[None, :], config.soc_initial, config.soc_target
    )[0]
    soc = np.append(trajectory.soc, trajectory.soc_final)
    worst = float(np.max(np.abs(soc - episode.soc)))
    if worst > SOC_TOLERANCE:
        raise RunAborted(f"study: the compiled plant's SOC is {worst:.2g} off the production one")
    return trajectory


def _generators(seed: int) -> list[np.random.Generator]:
    """Initial weights; seeding and sampling; driving and learning."""
    children = np.random.SeedSequence(seed).spawn(3)
    return [np.random.Generator(np.random.PCG64(child)) for child in children]


def _peak_rss_bytes() -> int:
    """Of this process so far; Linux counts kilobytes, macOS bytes."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024
