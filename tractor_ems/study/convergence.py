"""When a learning curve has converged: one rule, fixed before any result, for every curve.

The paper reads its episodes off plots of training reward and states no rule. This one looks at
greedy evaluations, which exploration does not blur.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from tractor_ems.study.paper_values import episodes_text
from tractor_ems.study.statistics import (
    RESAMPLES,
    Interval,
    interquartile_mean,
    iqm_interval,
    pairwise_probability,
    stratified_bootstrap,
)
from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.trajectory import FloatArray, IntArray

REACHED = 0.95
"""Share of the way from the first evaluation to the final value that counts as there."""

FINAL_SHARE = 0.10
"""Share of the evaluations whose median is the final value."""

HOLD_SHARE = 0.10
"""Share of the evaluations for which a curve must hold its level."""

LEAST_EVALUATIONS = 5
"""Least number of evaluations in either share, and the width of the running median."""

MIN_SEEDS = 5
"""Runs below which no difference is claimed; 10 are better."""

SpeedVerdict = Literal["yes", "no", "not resolved"]


@dataclass(frozen=True)
class Convergence:
    """One curve's answer.

    Attributes:
        episodes: training episodes until convergence; None: not within the budget.
        censored_at: the budget, the curve's last evaluation [episodes].
        reason: why it is censored; empty where it converged.
    """

    episodes: int | None
    censored_at: int
    reason: str

    @property
    def at_least(self) -> int:
        """Episodes, or the budget where they are censored: a lower bound."""
        return self.censored_at if self.episodes is None else self.episodes

    @property
    def text(self) -> str:
        """``37,000``, or ``> 40,000`` where it is censored."""
        if self.episodes is None:
            return f"> {episodes_text(self.censored_at)}"
        return episodes_text(self.episodes)


@dataclass(frozen=True)
class RowConvergence:
    """Episodes of one row over its seeds, censored seeds counted at the budget.

    Attributes:
        runs: one per seed.
        episodes: interquartile mean with its interval.
        censored: number of censored seeds.
        lower_bound: the interquartile mean counts a censored seed, so the truth is larger. One
            censored seed of five is outside the middle half and does not.
        note: what was done about censored seeds; empty without any.
    """

    runs: tuple[Convergence, ...]
    episodes: Interval
    censored: int
    lower_bound: bool
    note: str

    @property
    def text(self) -> str:
        """``37,000 [35,000, 39,000]``, or ``> 34,000 (3 of 5 seeds censored)``."""
        value, runs = episodes_text(self.episodes.value), len(self.runs)
        if self.lower_bound:
            return f"> {value} ({self.censored} of {runs} seeds censored)"
        if runs < 2:
            return f"{value} (1 run)"
        low, high = episodes_text(self.episodes.low), episodes_text(self.episodes.high)
        more = f", {self.censored} of {runs} seeds censored" if self.censored else ""
        return f"{value} [{low}, {high}]{more}"


@dataclass(frozen=True)
class SpeedComparison:
    """Does the first row converge sooner than the second?

    Attributes:
        sooner: probability that a run of the first converges sooner than one of the second.
        saving: 1 - episodes of the first / episodes of the second, what the paper calls "x %
            faster"; censored seeds counted at the budget.
        censored: censored seeds of the first and of the second.
        verdict: yes or no where the interval of ``saving`` excludes 0 whatever the censored seeds
            would have done later.
        reason: why it is not resolved; empty where it is.
    """

    sooner: Interval
    saving: Interval
    censored: tuple[int, int]
    verdict: SpeedVerdict
    reason: str


def converged(episode: IntArray, eval_return: FloatArray) -> Convergence:
    """The rule.

    final = median of the last 10 % of the evaluations, at least 5
    level = first + 0.95 (final - first)

    Returns are negative for most rewards, and 95 % of a negative value is better than the value;
    so the level is 95 % of the way that the curve went. Converged is the first evaluation from
    which the running median of 5 stays at or above the level to the end. It must do so for 10 %
    of the evaluations, at least 5, before those that define ``final``: a curve that still climbs
    evenly is near its own last values too, and has not converged.

    Args:
        episode: training episodes done at each evaluation, increasing, shape (K,).
        eval_return: return of the greedy policy then, shape (K,).

    Raises:
        ConfigError: shapes differ, no evaluation, episodes not increasing, or a return that is
            not finite.
    """
    budget = _checked_budget(episode, eval_return)
    count = len(eval_return)
    last, hold = _share(FINAL_SHARE, count), _share(HOLD_SHARE, count)
    if count <= last + hold:
        return Convergence(
            None, budget, f"{count} evaluations, the rule needs more than {last + hold}"
        )
    first, final = float(eval_return[0]), float(np.median(eval_return[-last:]))
    if final <= first:
        return Convergence(None, budget, "ends no better than its first evaluation")
    level = first + REACHED * (final - first)
    return _held(episode, eval_return, level, hold + last, begin=1)


def reached_optimum(
    episode: IntArray, eval_return: FloatArray, random_return: float, optimum_return: float
) -> Convergence:
    """First evaluation from which the return stays at 95 % of the way to the exact optimum.

    The same rule with a level that does not depend on the curve: a curve can converge without
    reaching the optimum.

    Args:
        random_return: of the random feasible policy.
        optimum_return: of exact DP on the same reward.

    Raises:
        ConfigError: as ``converged``, or the optimum is not better than random.
    """
    budget = _checked_budget(episode, eval_return)
    if not random_return < optimum_return < np.inf:
        raise ConfigError(
            f"optimum_return: {optimum_return:g}, allowed more than random's {random_return:g}"
        )
    hold = _share(HOLD_SHARE, len(eval_return))
    if len(eval_return) < hold:
        return Convergence(
            None, budget, f"{len(eval_return)} evaluations, the rule needs {hold} or more"
        )
    level = random_return + REACHED * (optimum_return - random_return)
    return _held(episode, eval_return, level, hold, begin=0)


def convergence_over_seeds(
    runs: Sequence[Convergence], rng: np.random.Generator, resamples: int = RESAMPLES
) -> RowConvergence:
    """Interquartile mean over the seeds of a row, with its bootstrap interval.

    Raises:
        ConfigError: there is no run.
    """
    episodes = np.array([run.at_least for run in runs], dtype=np.float64)
    interval = iqm_interval(episodes, rng, resamples)
    censored = sum(run.episodes is None for run in runs)
    # Censored seeds rank last: up to a quarter of them lies outside the middle half, unless a
    # seed with a larger budget converged later than another was cut off.
    latest = max((run.episodes for run in runs if run.episodes is not None), default=0)
    cut = min((run.censored_at for run in runs if run.episodes is None), default=latest)
    counted = censored > len(runs) / 4 or (censored > 0 and cut < latest)
    note = ""
    if censored:
        note = (
            f"{censored} of {len(runs)} seeds not converged within the budget and counted at it; "
            "the interval is too narrow upwards"
        )
    return RowConvergence(tuple(runs), interval, censored, counted, note)


def compare_speed(
    first: Sequence[Convergence],
    second: Sequence[Convergence],
    rng: np.random.Generator,
    resamples: int = RESAMPLES,
) -> SpeedComparison:
    """Does ``first`` converge sooner? Yes or no only where the 95 % interval excludes equality.

    A pair of runs of which it is unknown who was sooner counts half: ties, both censored, and one
    that converged after the other's budget. Counting censored seeds at the budget makes a row look
    faster than it is, so a row with censored seeds can be found slower but never faster.

    Raises:
        ConfigError: a row has no runs.
    """
    wins = np.array([[_sooner(a, b) for b in second] for a in first], dtype=np.float64)
    sooner = pairwise_probability(wins, rng, resamples)
    counted = [
        np.maximum(np.array([run.at_least for run in runs], dtype=np.float64), 1.0)
        for runs in (first, second)
    ]
    saving = stratified_bootstrap(
        lambda strata: 1.0 - interquartile_mean(strata[0]) / interquartile_mean(strata[1]),
        counted,
        rng,
        resamples,
    )
    censored = tuple(sum(run.episodes is None for run in runs) for runs in (first, second))
    verdict, reason = _speed_verdict(saving, censored[0], censored[1])
    return SpeedComparison(sooner, saving, (censored[0], censored[1]), verdict, reason)


def _speed_verdict(
    saving: Interval, censored_first: int, censored_second: int
) -> tuple[SpeedVerdict, str]:
    if saving.runs < MIN_SEEDS:
        return "not resolved", f"{saving.runs} seeds, {MIN_SEEDS} are needed"
    if saving.low > 0.0 and not censored_first:
        return "yes", ""
    if saving.high < 0.0 and not censored_second:
        return "no", ""
    if saving.low <= 0.0 <= saving.high:
        return "not resolved", "the 95 % interval includes equality"
    return "not resolved", "the row that looks faster has censored seeds"


def _sooner(first: Convergence, second: Convergence) -> float:
    a, b = first.episodes, second.episodes
    if a is not None and b is not None:
        return 0.5 + 0.5 * float(np.sign(b - a))
    if a is not None and a <= second.censored_at:
        return 1.0
    if b is not None and b <= first.censored_at:
        return 0.0
    return 0.5


def _held(
    episode: IntArray, eval_return: FloatArray, level: float, hold: int, begin: int
) -> Convergence:
    """First evaluation, from ``begin`` on, from which the level is held to the end, ``hold``
    evaluations at least."""
    budget = int(episode[-1])
    below = np.flatnonzero(running_median(eval_return) < level)
    at = max(int(below[-1]) + 1 if len(below) else 0, begin)
    if at > len(eval_return) - hold:
        why = "is below its level" if at >= len(eval_return) else "reaches its level too late"
        return Convergence(None, budget, f"{why}: fewer than {hold} evaluations hold it")
    return Convergence(int(episode[at]), budget, "")


def running_median(values: FloatArray, width: int = LEAST_EVALUATIONS) -> FloatArray:
    """Centred running median, over what there is of the window at both ends, shape (K,)."""
    half = width // 2
    count = len(values)
    found = np.empty(count)
    if count >= width:
        found[half : count - half] = np.median(sliding_window_view(values, width), axis=-1)
    for i in range(count):
        if count < width or not half <= i < count - half:
            found[i] = np.median(values[max(i - half, 0) : i + half + 1])
    return found


def _share(share: float, count: int) -> int:
    return max(LEAST_EVALUATIONS, int(np.ceil(share * count)))


def _checked_budget(episode: IntArray, eval_return: FloatArray) -> int:
    if np.shape(episode) != np.shape(eval_return) or np.size(episode) == 0:
        raise ConfigError(
            f"episode, eval_return: shapes {np.shape(episode)} and {np.shape(eval_return)}, "
            "allowed equal and not empty"
        )
    if np.any(np.diff(episode) <= 0):
        raise ConfigError("episode: does not increase, allowed increasing numbers")
    if not np.isfinite(eval_return).all():
        raise ConfigError("eval_return: a value is not finite, allowed finite numbers")
    return int(episode[-1])
