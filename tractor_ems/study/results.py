"""What the study found, as data: tables, figures and claims are functions of this alone."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from tractor_ems.learning.tabular import TableStudy
from tractor_ems.study.rows import Row
from tractor_msgs_py.trajectory import FloatArray, IntArray, Trajectory


@dataclass(frozen=True)
class Outcome:
    """One drive over the study's cycle.

    Attributes:
        fuel_kg: fuel burnt.
        efficiency: crankshaft work over fuel energy; None when nothing was burnt.
        soc_initial, soc_final: fractions.
        engine_starts: number of starts.
        engine_on_s: time the engine ran [s].
        below_60kw_share: share of the engine's running time below 60 kW; None when it never ran.
        shortfall_j: undelivered demand [J].
        reward_sum: undiscounted sum of the row's reward, in the units a learner sees.
        dp_ratio: matched-SOC DP ratio; None with a reason in ``dp_note``.
        trajectory: the drive itself.
    """

    fuel_kg: float
    efficiency: float | None
    soc_initial: float
    soc_final: float
    engine_starts: int
    engine_on_s: float
    below_60kw_share: float | None
    shortfall_j: float
    reward_sum: float
    dp_ratio: float | None
    dp_note: str | None
    trajectory: Trajectory


@dataclass(frozen=True)
class Curve:
    """Progress of one run.

    Attributes:
        train_return: sum of rewards of every training episode, exploration included, shape (E,).
        episode: training episodes done at each evaluation, 0 is before the first, shape (K,).
        eval_return, eval_fuel_kg, eval_soc_final: of a greedy episode then, shape (K,).
    """

    train_return: FloatArray
    episode: IntArray
    eval_return: FloatArray
    eval_fuel_kg: FloatArray
    eval_soc_final: FloatArray


@dataclass(frozen=True)
class Run:
    """One trained agent.

    Attributes:
        row, seed: which.
        config_hash: SHA-256 of everything that decides the result.
        episodes, steps, updates: done.
        curve, outcome: how it learned, and the final greedy policy.
        seeding: counts and shares of seeded transitions, empty without seeding.
        table: of tabular rows.
        seconds, peak_rss_bytes: cost; not part of the result.
    """

    row: Row
    seed: int
    config_hash: str
    episodes: int
    steps: int
    updates: int
    curve: Curve
    outcome: Outcome
    seeding: Mapping[str, Any]
    table: TableStudy | None
    seconds: float
    peak_rss_bytes: int


@dataclass(frozen=True)
class Baseline:
    """Something that does not learn.

    Attributes:
        id: ``conventional``, ``dp``, ``best_point``, ``rule_based``, ``random_feasible``,
            ``myopic`` (greedy on the reward) or ``optimum`` (exact DP on the reward).
        reward: that ``reward_sum`` counts; one baseline row per reward and SOC_min.
        soc_min: of the plant.
        outcome: its drive.
    """

    id: str
    reward: str
    soc_min: float
    outcome: Outcome


@dataclass(frozen=True)
class Table1Row:
    """One column of the paper's Table 1, on ``paper_table1``.

    Attributes:
        id: ``conventional``, ``control_1`` or ``control_2``.
        fuel_kg, soc_final: here.
    """

    id: str
    fuel_kg: float
    soc_final: float


@dataclass(frozen=True)
class StudyResults:
    """Everything.

    Attributes:
        preset: its name; episodes_deep, episodes_tabular: budget of a run.
        steps_per_update: environment steps per gradient step of the networks.
        runs: rows by seeds, in the order of the configuration, seeds ascending.
        baselines, table1: see there.
        differences: "differences from the paper": subject, paper, here, why.
        provenance: command, package version, seeds, hashes, wall time, machine.
    """

    preset: str
    episodes_deep: int
    episodes_tabular: int
    steps_per_update: int
    runs: tuple[Run, ...]
    baselines: tuple[Baseline, ...]
    table1: tuple[Table1Row, ...]
    differences: tuple[Mapping[str, str], ...]
    provenance: Mapping[str, Any]

    @property
    def rows(self) -> tuple[Row, ...]:
        """Every row once, in order."""
        return tuple(dict.fromkeys(run.row for run in self.runs))

    def of(self, key: str) -> tuple[Run, ...]:
        """Runs of the row with this ``Row.key``, seeds ascending; empty where it was not run."""
        return tuple(run for run in self.runs if run.row.key == key)

    def baseline(self, name: str, reward: str = "fuel", soc_min: float = 0.70) -> Baseline:
        """One baseline.

        Raises:
            KeyError: there is none of that name, reward and SOC_min.
        """
        for item in self.baselines:
            if (item.id, item.reward) == (name, reward) and abs(item.soc_min - soc_min) < 1e-9:
                return item
        raise KeyError(f"{name} with reward {reward} at SOC_min {soc_min}")
