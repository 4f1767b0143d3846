"""Statistics of the held-out study: scores by seed and cycle, bootstrap over both, stratified by
operation. Works on rows alone; a run without a score counts as 0."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tractor_ems.study.statistics import CONFIDENCE, Interval, interquartile_mean
from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.trajectory import FloatArray, IntArray

TIE = 1e-5
"""Scores this close count as equal: less than the reference is known by."""

_PERCENTILES = (50.0 * (1.0 - CONFIDENCE), 50.0 * (1.0 + CONFIDENCE))

Rows = Sequence[Mapping[str, Any]]


@dataclass(frozen=True)
class Scores:
    """One policy's runs.

    Attributes:
        score: (S, C), dp_ratio by training seed and cycle, 0 where there is none.
        finished: (S, C), whether there is one.
        cycles: names, (C,); operation: (C,), numbers into ``operations``.
    """

    score: FloatArray
    finished: np.ndarray[Any, np.dtype[np.bool_]]
    cycles: tuple[str, ...]
    operation: IntArray
    operations: tuple[str, ...]

    def of(self, operation: str) -> "Scores":
        """Only one operation's cycles."""
        here = self.operation == self.operations.index(operation)
        names = tuple(name for name, kept in zip(self.cycles, here, strict=True) if kept)
        number = np.zeros(len(names), dtype=np.int64)
        return Scores(self.score[:, here], self.finished[:, here], names, number, (operation,))


def scores_of(rows: Rows) -> dict[str, Scores]:
    """Every policy's scores, over the same cycles in the same order.

    Raises:
        ConfigError: a policy lacks a run, or has one twice.
    """
    cycles = tuple(dict.fromkeys(row["cycle"] for row in rows))
    operation_of = {row["cycle"]: row["operation"] for row in rows}
    operations = tuple(dict.fromkeys(operation_of.values()))
    numbers = np.array([operations.index(operation_of[name]) for name in cycles], dtype=np.int64)
    found: dict[str, Scores] = {}
    for policy in dict.fromkeys(row["policy"] for row in rows):
        own = [row for row in rows if row["policy"] == policy]
        seeds = list(dict.fromkeys(row["seed"] for row in own))
        places = {(row["seed"], row["cycle"]): row["dp_ratio"] for row in own}
        if len(places) != len(own) or len(own) != len(seeds) * len(cycles):
            raise ConfigError(
                f"rows of {policy}: {len(own)} of {len(places)} runs, allowed one for each of "
                f"{len(seeds)} seeds and {len(cycles)} cycles"
            )
        table = [[places[seed, cycle] for cycle in cycles] for seed in seeds]
        finished = np.array([[value is not None for value in line] for line in table])
        score = np.array([[value or 0.0 for value in line] for line in table], dtype=np.float64)
        found[policy] = Scores(score, finished, cycles, numbers, operations)
    return found


def draw_cycles(operation: IntArray, rng: np.random.Generator, resamples: int) -> IntArray:
    """Numbers of cycles, (B, C), drawn with replacement within each operation."""
    drawn = np.empty((resamples, len(operation)), dtype=np.int64)
    for number in np.unique(operation):
        here = np.flatnonzero(operation == number)
        drawn[:, here] = here[rng.integers(0, len(here), size=(resamples, len(here)))]
    return drawn


def interval_of(
    scores: Scores,
    statistic: Callable[[FloatArray], FloatArray],
    rng: np.random.Generator,
    resamples: int,
) -> Interval:
    """A statistic of all runs, (..., N) to (...), and its 95 % interval: seeds and cycles are
    drawn with replacement, cycles within their operations."""
    seeds, cycles = scores.score.shape
    which = rng.integers(0, seeds, size=(resamples, seeds))
    drawn = draw_cycles(scores.operation, rng, resamples)
    spread = statistic(
        scores.score[which[:, :, None], drawn[:, None, :]].reshape(resamples, seeds * cycles)
    )
    low, high = np.percentile(spread, _PERCENTILES)
    value = float(statistic(scores.score.reshape(1, -1))[0])
    return Interval(value, float(low), float(high), min(seeds, cycles))


def improvement(
    better: Scores, worse: Scores, rng: np.random.Generator, resamples: int
) -> Interval:
    """Probability that a run of ``better`` scores higher than one of ``worse`` on the same cycle,
    ties half; its interval by drawing cycles within operations, and seeds of both.

    Raises:
        ConfigError: the two drove different cycles.
    """
    if better.cycles != worse.cycles:
        raise ConfigError("improvement: the two policies drove different cycles")
    gain = better.score[:, None, :] - worse.score[None, :, :]
    wins = np.where(np.abs(gain) <= TIE, 0.5, (gain > 0.0).astype(np.float64))
    first, second, _ = wins.shape
    one = rng.integers(0, first, size=(resamples, first))
    two = rng.integers(0, second, size=(resamples, second))
    drawn = draw_cycles(better.operation, rng, resamples)
    spread = wins[one[:, :, None, None], two[:, None, :, None], drawn[:, None, None, :]]
    low, high = np.percentile(spread.mean(axis=(1, 2, 3)), _PERCENTILES)
    return Interval(float(wins.mean()), float(low), float(high), wins.shape[2])


def summary(scores: Scores, rng: np.random.Generator, resamples: int) -> dict[str, Any]:
    """Median, interquartile mean and worst of all runs, with intervals; a run without a score
    counts as 0, ``worst_finished`` leaves it out."""
    middle = interval_of(scores, lambda runs: np.median(runs, axis=-1), rng, resamples)
    iqm = interval_of(scores, interquartile_mean, rng, resamples)
    done = scores.score[scores.finished]
    return {
        "median": round(middle.value, 5),
        "median_ci95": [round(middle.low, 5), round(middle.high, 5)],
        "iqm": round(iqm.value, 5),
        "ci95": [round(iqm.low, 5), round(iqm.high, 5)],
        "worst": round(float(scores.score.min()), 5),
        "worst_finished": round(float(done.min()), 5) if done.size else None,
        "seed_medians": [round(float(x), 5) for x in np.median(scores.score, axis=1)],
        "seeds": scores.score.shape[0],
        "runs": scores.score.size,
        "failed": int(scores.score.size - done.size),
    }


def conduct(rows: Rows) -> dict[str, Any]:
    """How one policy drove, over all its runs: starts, SOC, violations, shortfall."""
    errors = np.abs([row["soc_final"] - row["soc_target"] for row in rows])
    starts = sum(row["engine_starts"] for row in rows)
    seeds = len({row["seed"] for row in rows})
    return {
        "starts_per_h": round(starts / sum(row["hours"] for row in rows), 3),
        "starts": round(starts / seeds, 1),
        "soc_min": round(min(row["soc_min"] for row in rows), 4),
        "soc_max": round(max(row["soc_max"] for row in rows), 4),
        "soc_swing": round(float(np.median([row["soc_max"] - row["soc_min"] for row in rows])), 4),
        "soc_error_mean": round(float(errors.mean()), 5),
        "soc_error_max": round(float(errors.max()), 5),
        "violations": sum(row["violations"] for row in rows),
        "shortfall_j": round(sum(row["shortfall_j"] for row in rows), 1),
    }


def plain(interval: Interval) -> dict[str, float]:
    """An interval as plain data."""
    return {
        "value": round(interval.value, 4),
        "low": round(interval.low, 4),
        "high": round(interval.high, 4),
    }


def analyse(rows: Rows, opponents: Sequence[str], resamples: int, seed: int = 0) -> dict[str, Any]:
    """The sections ``policies``, ``per_operation`` and ``pairwise`` of the results; equal rows
    give equal figures."""
    rng = np.random.Generator(np.random.PCG64(seed))
    scores = scores_of(rows)
    policies: dict[str, Any] = {}
    per_operation: dict[str, Any] = {}
    pairwise: dict[str, Any] = {}
    for name, own in scores.items():
        mine = [row for row in rows if row["policy"] == name]
        policies[name] = {**summary(own, rng, resamples), **conduct(mine)}
        per_operation[name] = {
            operation: {
                **summary(own.of(operation), rng, resamples),
                **conduct([row for row in mine if row["operation"] == operation]),
            }
            for operation in own.operations
        }
        pairwise[name] = {}
        for other in opponents:
            if other == name:
                continue
            parts = {
                operation: plain(
                    improvement(own.of(operation), scores[other].of(operation), rng, resamples)
                )
                for operation in own.operations
            }
            overall = plain(improvement(own, scores[other], rng, resamples))
            pairwise[name][other] = {"overall": overall, **parts}
            policies[name][f"improvement_over_{other}"] = overall["value"]
            policies[name][f"improvement_over_{other}_ci95"] = [overall["low"], overall["high"]]
    return {"policies": policies, "per_operation": per_operation, "pairwise": pairwise}


def robustness_table(rows: Rows, never_stop: str, order: Sequence[str] = ()) -> dict[str, Any]:
    """By policy and disturbance: mean score, loss against the undisturbed score on the same cycle
    over runs that finished in both, failed runs, violations, and whether that is no worse than
    ``never_stop``'s: neither more loss nor a larger share of failed runs. Disturbances come in
    the given order."""
    by_run = {(r["disturbance"], r["policy"], r["seed"], r["cycle"]): r for r in rows}
    names = dict.fromkeys(row["policy"] for row in rows)
    place = {name: number for number, name in enumerate(order)}
    listed = [d for d in dict.fromkeys(row["disturbance"] for row in rows) if d != "none"]
    listed.sort(key=lambda name: place.get(name, len(place)))
    found: dict[str, Any] = {name: {} for name in names}
    for name in names:
        for disturbance in listed:
            losses, scores, failed, broken = [], [], 0, 0
            for (which, policy, seed, cycle), row in by_run.items():
                if which != disturbance or policy != name:
                    continue
                before = by_run["none", policy, seed, cycle]["dp_ratio"]
                broken += row["violations"]
                if row["dp_ratio"] is None:
                    failed += 1
                    continue
                scores.append(row["dp_ratio"])
                if before is not None:
                    losses.append(before - row["dp_ratio"])
            runs = len(scores) + failed
            found[name][disturbance] = {
                "score": round(float(np.mean(scores)), 5) if scores else None,
                "loss": round(float(np.mean(losses)), 5) if losses else None,
                "failed": failed,
                "runs": runs,
                "violations": broken,
            }
    for name in names:
        for disturbance in listed:
            own, rule = found[name][disturbance], found[never_stop][disturbance]
            own["no_worse"] = _no_worse(own, rule)
    return found


def _no_worse(own: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    if own["loss"] is None or other["loss"] is None:
        return bool(own["loss"] is not None)
    share, others = own["failed"] / own["runs"], other["failed"] / other["runs"]
    return bool(own["loss"] <= other["loss"] + TIE and share <= others)
