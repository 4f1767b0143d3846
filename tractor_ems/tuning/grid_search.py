"""One grid search for every baseline: the same cycles, the same objective, a log of everything.

Objective: the largest median dp_ratio over the dev cycles among settings that leave no demand
unmet and end near the target SOC (mean and largest |final SOC - target| within the grid's bars).
Where no setting does, the one that misses by least counts: fewest cycles with unmet demand, then
the least excess over the two bars, then the median.
"""

import dataclasses
import json
import multiprocessing
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from tractor_ems.tuning.baseline_drives import baseline_policy, drive_all
from tractor_ems.tuning.closed_loop import FUEL, SHORTFALL, SOC_FINAL, STARTS
from tractor_ems.tuning.dev_set import DevCycle, dev_set, squeezed_set
from tractor_ems.tuning.grid import Grid, Preset, combinations
from tractor_msgs_py.atomic import write_bytes
from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.powertrain import PowertrainParams

Task = TypeVar("Task")
Found = TypeVar("Found")

Progress = Callable[[str, int, int], None]
"""Told what is under way, how much of it is done, and how much there is."""


@dataclass(frozen=True)
class Trial:
    """One setting of a policy and what it did on every cycle.

    Attributes:
        policy, settings: what was driven.
        fuel_kg, starts, soc_error, short: by cycle; short: whether demand was left unmet.
        ratio: dp_ratio by cycle, 0 where demand was left unmet; None: not scored, because the
            bars were missed.
    """

    policy: str
    settings: dict[str, Any]
    fuel_kg: FloatArray
    starts: FloatArray
    soc_error: FloatArray
    short: FloatArray
    ratio: FloatArray | None = None

    def summary(self) -> dict[str, Any]:
        """What is logged and reported, as plain data."""
        error = np.abs(self.soc_error)
        row: dict[str, Any] = {"policy": self.policy, "settings": self.settings}
        if self.ratio is not None:
            row |= {
                "median": round(float(np.median(self.ratio)), 5),
                "mean": round(float(self.ratio.mean()), 5),
                "worst": round(float(self.ratio.min()), 5),
            }
        row |= {
            "starts": int(self.starts.sum()),
            "short": int(self.short.sum()),
            "soc_mean": round(float(error.mean()), 4),
            "soc_max": round(float(error.max()), 4),
        }
        return row

    def to_json(self) -> dict[str, Any]:
        """A line of the log: the summary, and by cycle what it follows from."""
        line = {**self.summary(), "soc_final_error": [round(float(e), 4) for e in self.soc_error]}
        if self.ratio is not None:
            line["dp_ratio"] = [round(float(r), 5) for r in self.ratio]
        return line


@dataclass(frozen=True)
class Chosen:
    """The best setting of a policy, on the dev cycles and on squeezed work."""

    dev: Trial
    squeezed: Trial
    feasible: int
    tried: int


@dataclass(frozen=True)
class _Drive:
    """A task of a worker: one setting over a set of cycles."""

    policy: str
    settings: dict[str, Any]
    params: PowertrainParams
    soc: float
    demands_w: tuple[FloatArray, ...]
    train: tuple[str, ...]


@dataclass(frozen=True)
class _Score:
    """A task of a worker: the optima of one cycle at several ends."""

    cycle: DevCycle
    ends: tuple[float, ...]


def excess(trial: Trial, grid: Grid) -> tuple[int, float]:
    """By how much a setting misses the bars: cycles with unmet demand, SOC beyond the bars;
    (0, 0.0) where it holds them."""
    error = np.abs(trial.soc_error)
    beyond = max(float(error.mean()) - grid.soc_mean, 0.0)
    return int(trial.short.sum()), beyond + max(float(error.max()) - grid.soc_max, 0.0)


def search(
    params: PowertrainParams,
    grid: Grid,
    preset: Preset,
    out: Path,
    *,
    workers: int = 1,
    progress: Progress = lambda what, done, total: None,
) -> dict[str, Chosen]:
    """Drive every setting, choose one by policy, and write a log of JSON lines by policy into
    ``out``; optima are kept in ``out/optima``, which another search may use.

    Equal grids and powertrains give equal logs, whatever the number of workers.

    Raises:
        ConfigError, PolicyError, CycleError: see ``load_grid``.
    """
    soc = params.soc_initial if params.soc_target is None else params.soc_target
    kept = out / "optima"
    kept.mkdir(parents=True, exist_ok=True)
    names = grid.squeezed.names[:: preset.every]
    dev = dev_set(params, grid.dev.names[:: preset.every], soc, kept)
    squeezed = squeezed_set(params, names, soc, grid.squeezed.seed, kept)
    train = grid.train.names[:: preset.every]
    tried = [
        (name, settings)
        for name, axes in preset.policies.items()
        for settings in combinations(axes)
    ]
    with _Workers(workers) as pool:

        def scored(
            of: Sequence[tuple[str, dict[str, Any]]], cycles: Sequence[DevCycle], what: str
        ) -> list[Trial]:
            demands = tuple(cycle.power_demand_w for cycle in cycles)
            tasks = [_Drive(*pair, params, soc, demands, train) for pair in of]
            totals = pool.map(_drive, tasks, lambda n: progress(what, n, len(tasks)))
            trials = [_trial(task, found) for task, found in zip(tasks, totals, strict=True)]
            return _scored(pool, grid, trials, cycles, f"optima, {what}", progress)

        trials = scored(tried, dev, "settings")
        by_name = {n: [t for t in trials if t.policy == n] for n in preset.policies}
        best = [min(of, key=lambda t: _rank(t, grid)) for of in by_name.values()]
        last = scored([(t.policy, t.settings) for t in best], squeezed, "squeezed work")
    for name, of in by_name.items():
        _write_log(out / f"{name}.jsonl", of, [cycle.name for cycle in dev])
    return {
        dev_trial.policy: Chosen(
            dev_trial,
            squeezed_trial,
            sum(excess(t, grid) == (0, 0.0) for t in by_name[dev_trial.policy]),
            len(by_name[dev_trial.policy]),
        )
        for dev_trial, squeezed_trial in zip(best, last, strict=True)
    }


def _rank(trial: Trial, grid: Grid) -> tuple[int, float, float, float]:
    """Smaller is better; ties go to the better mean, then to what stands first in the grid."""
    if trial.ratio is None:
        return (*excess(trial, grid), 0.0, 0.0)
    return (*excess(trial, grid), -float(np.median(trial.ratio)), -float(trial.ratio.mean()))


def _scored(
    pool: "_Workers",
    grid: Grid,
    trials: Sequence[Trial],
    cycles: Sequence[DevCycle],
    what: str,
    progress: Progress,
) -> list[Trial]:
    """The same with ratios where a setting can be chosen: those that miss the bars by least."""
    least = {
        name: min(excess(t, grid) for t in trials if t.policy == name)
        for name in {t.policy for t in trials}
    }
    at = [i for i, t in enumerate(trials) if excess(t, grid) == least[t.policy]]
    tasks = [
        _Score(cycle, tuple(cycle.reference.soc_initial + trials[i].soc_error[c] for i in at))
        for c, cycle in enumerate(cycles)
    ]
    least_kg = pool.map(_score, tasks, lambda n: progress(what, n, len(tasks)))
    found = list(trials)
    for i, kg in zip(at, np.transpose(least_kg), strict=True):
        ratio = np.where(trials[i].short > 0, 0.0, kg / trials[i].fuel_kg)
        found[i] = dataclasses.replace(trials[i], ratio=ratio)
    return found


def _trial(task: _Drive, totals: FloatArray) -> Trial:
    return Trial(
        policy=task.policy,
        settings=task.settings,
        fuel_kg=totals[:, FUEL],
        starts=totals[:, STARTS],
        soc_error=totals[:, SOC_FINAL] - task.soc,
        short=(totals[:, SHORTFALL] > 0.0).astype(float),
    )


def _drive(task: _Drive) -> FloatArray:
    policy = baseline_policy(task.policy, task.params, task.settings, task.train)
    return drive_all(policy, task.params, task.demands_w, task.soc)


def _score(task: _Score) -> list[float]:
    return [task.cycle.reference.fuel_kg(float(end)) for end in task.ends]


def _write_log(path: Path, trials: Iterable[Trial], cycles: Sequence[str]) -> None:
    lines: list[dict[str, Any]] = [{"cycles": list(cycles)}, *(t.to_json() for t in trials)]
    text = "".join(
        json.dumps(line, separators=(",", ":"), allow_nan=False) + "\n" for line in lines
    )
    write_bytes(path, text.encode())


class _Workers:
    """``map`` over processes, or in this one where one is enough."""

    def __init__(self, workers: int) -> None:
        spawn = multiprocessing.get_context("spawn")
        self._pool = ProcessPoolExecutor(workers, mp_context=spawn) if workers > 1 else None

    def __enter__(self) -> "_Workers":
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)

    def map(
        self, function: Callable[[Task], Found], tasks: Sequence[Task], done: Callable[[int], None]
    ) -> list[Found]:
        """Results in the order of the tasks; ``done`` is told how many there are."""
        results = map(function, tasks) if self._pool is None else self._pool.map(function, tasks)
        found: list[Found] = []
        done(0)
        for result in results:
            found.append(result)
            done(len(found))
        return found
