"""Study results whose truth is known: every row of the study, real drives over the planter cycle,
and learning curves that reach their end value at a share of the budget that the test chose."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np

from tractor_ems.drive import drive
from tractor_ems.learning.mdp import Mdp, make_mdp, reward_of
from tractor_ems.learning.rewards import RewardConfig, RewardKind
from tractor_ems.policies.protocol import ANY_RUN, limits_of
from tractor_ems.study.results import (
    Baseline,
    Curve,
    Outcome,
    Run,
    StudyResults,
    Table1Row,
    TableStudy,
)
from tractor_ems.study.rows import Row
from tractor_msgs_py.observation import Observation, ObservationSpec
from tractor_msgs_py.trajectory import FloatArray, Trajectory
from tractor_sim.config import load_powertrain
from tractor_sim.duty_cycle.library import load_cycle
from tractor_sim.figures import run_figures
from tractor_sim.powertrain import (
    Command,
    PowertrainParams,
    feasible_battery_power_w,
    project,
)

SOC_INITIAL, SOC_TARGET = 0.85, 0.836
EVALUATIONS = 100


@dataclass(frozen=True)
class Plan:
    """What a row's runs look like.

    Attributes:
        converges_at: share of the budget at which the curve reaches its end value, about 5 %
            sooner or later by seed; None: it climbs to the last evaluation.
        drive: the final greedy drive, a key of ``DRIVES``.
        pearson: of tabular rows.
        visited: share of a table's entries that were visited.
    """

    converges_at: float | None = 0.4
    drive: str = "shaped"
    pearson: float | None = -0.213
    visited: float = 0.03


@dataclass(frozen=True)
class Band:
    """Engine at the demand plus an offset, clipped to low..high, where demand exceeds a
    threshold; else off. One number of each, offset and band shifted by ``shift_w`` per run."""

    above_w: float
    low_w: float
    high_w: float
    offset_w: float = 0.0
    shift_w: FloatArray = field(default_factory=lambda: np.zeros(1))
    name: str = "band"
    spec: ObservationSpec = ANY_RUN

    def init(self, batch: int) -> None:
        """No memory."""

    def act(self, observation: Observation, state: None) -> tuple[Command, None]:
        """The band's battery power, projected on the feasible set."""
        demand_w = observation.power_demand_w
        engine_w = np.clip(demand_w + self.offset_w, self.low_w, self.high_w) + self.shift_w
        engine_w = np.where(demand_w > self.above_w, np.maximum(engine_w, 0.0), 0.0)
        lb, ub = feasible_battery_power_w(limits_of(observation), demand_w)
        battery_w = project(demand_w - engine_w, lb, ub)
        return Command(battery_w, np.where(engine_w <= 0.0, 0.0, np.nan)), state


DRIVES: dict[str, Band] = {
    "conventional": Band(-1.0, 0.0, 275e3),
    "dp": Band(60e3, 144e3, 144e3),
    "best_point": Band(-1.0, 150e3, 150e3),
    "rule_based": Band(110e3, 0.0, 275e3),
    "random_feasible": Band(-1.0, 0.0, 275e3, offset_w=-35e3),
    "myopic": Band(np.inf, 0.0, 0.0),
    "shaped": Band(110e3, 115e3, 185e3),
    "low_power": Band(165e3, 50e3, 50e3),
    "poor": Band(-1.0, 20e3, 90e3, offset_w=-80e3),
}

DEFAULT_PLANS: dict[str, Plan] = {
    "q": Plan(0.5, "poor"),
    "double_q": Plan(0.5, "poor"),
    "dqn": Plan(0.7, "low_power"),
    "ddqn": Plan(0.2, "low_power"),
    "ddqn_shaped": Plan(0.6),
    "ddqn_shaped_dp": Plan(0.4),
    "ddqn_shaped_mixed": Plan(0.5),
    "ddqn_shaped_rule": Plan(0.7),
    "double_q_interpolated": Plan(0.5, "low_power"),
    "ddqn_soft_target": Plan(0.3, "low_power"),
    "ddqn_fuel_knots": Plan(0.1, "low_power"),
}


def study_rows() -> tuple[Row, ...]:
    """Every row of the study."""
    fuel: dict[str, Any] = {"reward": "fuel", "soc_min": 0.70}
    shaped: dict[str, Any] = {"algorithm": "ddqn", "reward": "piecewise", "soc_bins": 200}
    seeded = {"dp": "DP", "mixed": "DP + rules", "rule": "rules"}
    rows = [
        Row("q", "Q-learning", "paper", "q", soc_bins=50, **fuel),
        Row("double_q", "Double Q-learning", "paper", "double_q", soc_bins=50, **fuel),
        Row("dqn", "DQN", "paper", "dqn", soc_bins=200, **fuel),
        Row("ddqn", "DDQN", "paper", "ddqn", soc_bins=200, **fuel),
    ]
    for soc_min in (0.70, 0.836):
        here = {**shaped, "soc_min": soc_min}
        rows.append(Row("ddqn_shaped", "DDQN, shaped", "paper", **here))
        for kind, name in seeded.items():
            label = f"DDQN, shaped, seeded by {name}"
            here_seeded = {**here, "seeding": kind, "epsilon_start": 0.5}
            rows.append(Row(f"ddqn_shaped_{kind}", label, "paper", **here_seeded))
    tight = {**shaped, "soc_min": 0.836}
    dp = {**tight, "seeding": "dp", "epsilon_start": 0.5, "replay": "kept"}
    knots: dict[str, Any] = {"mapping": "p_eng_knots", "actions": 65}
    corrected = {**shaped, "reward": "piecewise_corrected", "soc_min": 0.70}
    return (
        *rows,
        Row(
            "double_q_interpolated",
            "Double Q, interpolated",
            "ablation",
            "double_q",
            soc_bins=50,
            interpolate=True,
            **fuel,
        ),
        Row(
            "ddqn_soft_target",
            "DDQN, soft target",
            "ablation",
            "ddqn",
            target_every=1,
            target_rate=0.005,
            **fuel,
        ),
        Row(
            "ddqn_shaped_continuous_soc",
            "DDQN, continuous SOC",
            "ablation",
            **{**tight, "soc_bins": None},
        ),
        Row("ddqn_shaped_knots", "DDQN, shaped, knots", "ablation", **tight, **knots),
        Row("ddqn_shaped_dp_kept", "DDQN, DP seeds kept", "ablation", **dp),
        Row("ddqn_shaped_dp_margin", "DDQN, DP margin", "ablation", **dp, margin=0.8),
        Row("ddqn_corrected", "DDQN, corrected reward", "ablation", **corrected),
        Row("ddqn_corrected_knots", "DDQN, corrected, knots", "ablation", **corrected, **knots),
        Row("ddqn_fuel_knots", "DDQN, knots", "ablation", "ddqn", **fuel, **knots),
    )


def build_results(
    seed: int = 0,
    seeds: int = 5,
    episodes: int = 60,
    plans: Mapping[str, Plan] | None = None,
    episodes_tabular: int | None = None,
) -> StudyResults:
    """A whole study, made up.

    Args:
        seed: of the noise.
        seeds: runs per row.
        episodes: budget of a network's run; curves have at most 101 evaluations.
        plans: over ``DEFAULT_PLANS``, by row key (``ddqn@0.7``) or id.
        episodes_tabular: budget of a table's run; None: as the networks'.
    """
    wanted = {**DEFAULT_PLANS, **(plans or {})}
    rows = study_rows()
    budget = {True: episodes_tabular or episodes, False: episodes}
    runs = []
    for place, row in enumerate(rows):
        plan = wanted.get(row.key, wanted.get(row.id, Plan()))
        for index in range(seeds):
            rng = np.random.default_rng([seed, place, index])
            outcome = outcome_of(plan.drive, row.reward, row.soc_min, index)
            runs.append(_run(row, index, plan, outcome, budget[row.tabular], rng))
    return StudyResults(
        preset="synthetic",
        episodes_deep=episodes,
        episodes_tabular=budget[True],
        steps_per_update=4,
        runs=tuple(runs),
        baselines=_baselines(rows),
        table1=(
            Table1Row("conventional", 5.36, 0.80),
            Table1Row("control_1", 4.85, 0.71),
            Table1Row("control_2", 3.80, 0.65),
        ),
        differences=(
            {
                "subject": "gamma",
                "kind": "silent",
                "paper": "not stated",
                "here": "0.99",
                "why": "made up",
            },
            {
                "subject": "engine map",
                "kind": "silent",
                "paper": "not printed",
                "here": "curve",
                "why": "made up",
            },
        ),
        provenance={
            "command": "ems study paper --preset synthetic",
            "version": "0.0.0",
            "seeds": list(range(seeds)),
            "wall_s": 1.0,
            "machine": "none",
        },
    )


def curve_of(
    first: float,
    last: float,
    converges_at: float | None,
    episodes: int,
    rng: np.random.Generator,
    noise: float = 0.005,
) -> Curve:
    """Climbs evenly from ``first`` to ``last``, there at ``converges_at`` of the budget, with
    noise of ``noise`` times the climb; None: it is there at the last evaluation only."""
    episode = np.unique(np.linspace(0, episodes, min(episodes, EVALUATIONS) + 1).astype(np.int64))
    done = np.minimum(episode / episodes / (converges_at or 1.0), 1.0)
    climb = last - first
    returns = first + climb * (done + noise * rng.standard_normal(len(episode)))
    returns[0] = first
    at_train = np.interp(np.arange(1, episodes + 1), episode, returns)
    explored = np.linspace(0.5, 0.02, episodes) * abs(climb)
    return Curve(
        train_return=at_train - explored * rng.random(episodes),
        episode=episode,
        eval_return=returns,
        eval_fuel_kg=6.0 - 0.6 * done,
        eval_soc_final=0.80 + 0.036 * done,
    )


def _run(
    row: Row, index: int, plan: Plan, outcome: Outcome, episodes: int, rng: np.random.Generator
) -> Run:
    first = outcome_of("random_feasible", row.reward, row.soc_min, 0).reward_sum
    share = plan.converges_at
    if share is not None:
        share *= 1.0 + 0.05 * rng.uniform(-1.0, 1.0)
    return Run(
        row=row,
        seed=index,
        config_hash=f"{index:064x}",
        episodes=episodes,
        steps=766 * episodes,
        updates=766 * episodes // 4,
        curve=curve_of(first, outcome.reward_sum, share, episodes, rng),
        outcome=outcome,
        seeding=_seeding(row),
        table=_table(plan, rng) if row.tabular else None,
        seconds=1.0,
        peak_rss_bytes=10**8,
    )


def _seeding(row: Row) -> dict[str, dict[str, float]]:
    """As runs report it: a quarter of a replay of 200,000 by each expert, from 66 bags."""
    experts: dict[str, tuple[str, ...]] = {
        "none": (),
        "dp": ("dp",),
        "mixed": ("dp", "rule_based"),
        "rule": ("rule_based",),
    }
    part = {
        "wanted": 50_000,
        "available": 66 * 765,
        "distinct": 50_100,
        "seeded": 50_000,
        "share": 0.25,
    }
    return {name: dict(part) for name in experts[row.seeding]}


def _table(plan: Plan, rng: np.random.Generator) -> TableStudy:
    pairs = 50 * 766 * 1600
    q = rng.standard_normal(500)
    pearson = plan.pearson
    if pearson is not None:
        pearson = float(np.clip(pearson + 0.01 * rng.standard_normal(), -1.0, 1.0))
    visits = np.zeros((50, 766), dtype=np.int64)
    visits[20:38] = rng.poisson(3.0, (18, 766))
    return TableStudy(
        state_visits=visits,
        pairs=pairs,
        pairs_feasible=int(0.8 * pairs),
        pairs_visited=int(plan.visited * pairs),
        pearson=pearson,
        sample_q=q,
        sample_reward=-0.213 * q + 0.98 * rng.standard_normal(500),
        bytes=2 * 4 * pairs,
    )


def _baselines(rows: tuple[Row, ...]) -> tuple[Baseline, ...]:
    names = ("conventional", "dp", "best_point", "rule_based", "random_feasible", "myopic")
    found = []
    for reward, soc_min in dict.fromkeys((row.reward, row.soc_min) for row in rows):
        outcomes = {name: outcome_of(name, reward, soc_min, 0) for name in DRIVES}
        best = max(outcomes.values(), key=lambda outcome: outcome.reward_sum)
        found += [Baseline(name, reward, soc_min, outcomes[name]) for name in names]
        found.append(Baseline("optimum", reward, soc_min, best))
    return tuple(found)


@lru_cache(maxsize=8)
def plant(soc_min: float) -> PowertrainParams:
    """The paper's powertrain with this lower SOC limit."""
    params = load_powertrain("paper")
    return replace(params, battery=replace(params.battery, soc_min=soc_min))


@lru_cache(maxsize=64)
def _drives(name: str, soc_min: float) -> list[Trajectory]:
    """Eleven drives that differ by some 100 W of engine power; the first is the drive itself."""
    band = DRIVES[name]
    shift_w = np.linspace(0.0, 1e3, 11)
    moved = Band(band.above_w, band.low_w, band.high_w, band.offset_w, shift_w)
    demand_w = np.tile(load_cycle("planter").power_demand_w, (len(shift_w), 1))
    return drive(moved, plant(soc_min), demand_w, SOC_INITIAL, SOC_TARGET)


@lru_cache(maxsize=8)
def _mdp(reward: RewardKind, soc_min: float) -> Mdp:
    return make_mdp(
        plant(soc_min),
        load_cycle("planter").power_demand_w,
        RewardConfig(kind=reward, start_price_kg=0.0),
        mapping="p_batt_grid",
        actions=1600,
        soc_initial=SOC_INITIAL,
        soc_target=SOC_TARGET,
    )


@lru_cache(maxsize=512)
def outcome_of(name: str, reward: RewardKind, soc_min: float, index: int) -> Outcome:
    """A real drive under ``DRIVES[name]``; its ``dp_ratio`` is efficiency over the best there is,
    which on a lossless battery is close."""
    trajectory = _drives(name, soc_min)[index % 11]
    figures = run_figures(trajectory, plant(soc_min))
    on = trajectory.engine_on & (trajectory.engine_power_w > 0.0)
    soc = np.append(trajectory.soc, trajectory.soc_final)
    mdp = _mdp(reward, soc_min)
    reward_sum = sum(
        reward_of(mdp, *step)
        for step in zip(
            np.where(on, trajectory.engine_power_w, 0.0),
            trajectory.fuel_kg,
            soc[:-1],
            soc[1:],
            strict=True,
        )
    )
    efficiency = figures["efficiency"]
    return Outcome(
        fuel_kg=figures["fuel_kg"],
        efficiency=efficiency,
        soc_initial=SOC_INITIAL,
        soc_final=figures["soc_final"],
        engine_starts=figures["engine_starts"],
        engine_on_s=float(on.sum()),
        below_60kw_share=float((trajectory.engine_power_w[on] < 60e3).mean())
        if on.any()
        else None,
        shortfall_j=figures["shortfall_j"],
        reward_sum=float(reward_sum),
        dp_ratio=None if efficiency is None else min(efficiency / 0.437, 1.0),
        dp_note="nothing burnt" if efficiency is None else None,
        trajectory=trajectory,
    )
