"""Statistics of a few seeds: interquartile mean, bootstrap intervals, probability of improvement,
and the correlation that the paper reports. Nothing here knows a row or a claim."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from tractor_ems.study.paper_values import PEARSON_SCALE
from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.trajectory import FloatArray

RESAMPLES = 2000
"""Resamples of a bootstrap: the ends of a 95 % interval then rest on 50 of them each."""

CONFIDENCE = 0.95

COVERAGE_5 = 0.91
"""How often the 95 % interval of 5 normal runs covers the truth (measured)."""

_CHUNK = 256


@dataclass(frozen=True)
class Interval:
    """A statistic and its 95 % bootstrap interval.

    Attributes:
        value: over the runs themselves.
        low, high: ends of the percentile interval; equal to ``value`` where there is one run.
        runs: of the smallest stratum. On normal runs the interval of 5 covers the truth in 91 %
            of cases (``COVERAGE_5``) instead of 95 %, of 10 in 94 % (measured; the tests hold a
            looser bound).
    """

    value: float
    low: float
    high: float
    runs: int

    def text(self, digits: int = 3) -> str:
        """``0.970 [0.960, 0.980]``; one run has no interval."""
        value, low, high = (
            f"{round(number, digits) + 0.0:.{digits}f}"  # + 0.0 turns -0.0 into 0.0
            for number in (self.value, self.low, self.high)
        )
        return f"{value} (1 run)" if self.runs < 2 else f"{value} [{low}, {high}]"


@dataclass(frozen=True)
class CurveBand:
    """Pointwise interquartile mean of curves and its 95 % interval, each of shape (K,)."""

    value: FloatArray
    low: FloatArray
    high: FloatArray
    runs: int


Statistic = Callable[[Sequence[FloatArray]], FloatArray]
"""Strata of shapes (B, n_i) to one number per batch element, shape (B,)."""


def interquartile_mean(values: FloatArray, axis: int = -1) -> FloatArray:
    """Mean of the middle half along an axis.

    A value on the edge of the middle half counts with the fraction that lies inside: of 5 sorted
    values the second and fourth count 3/4. (A trimmed mean that drops whole values only would use
    5 values' middle 60 %.)

    Raises:
        ConfigError: there are no values, or one is not finite.
    """
    data = _checked(values, "values")
    count = data.shape[axis]
    edges = np.arange(count + 1) / count
    inside = np.clip(edges[1:], 0.25, 0.75) - np.clip(edges[:-1], 0.25, 0.75)
    ordered = np.sort(np.moveaxis(data, axis, -1), axis=-1)
    mean: FloatArray = ordered @ (inside / inside.sum())
    # Rounding of the weights must not carry the mean of equal values beyond them.
    return np.clip(mean, ordered[..., 0], ordered[..., -1])


def stratified_bootstrap(
    statistic: Statistic,
    strata: Sequence[FloatArray],
    rng: np.random.Generator,
    resamples: int = RESAMPLES,
) -> Interval:
    """95 % percentile interval; seeds are drawn with replacement within each stratum (row).

    Args:
        statistic: vectorised over a leading batch axis.
        strata: one array of runs per row, each of shape (n_i,).
        rng: draws the resamples.
        resamples: > 0.

    Raises:
        ConfigError: an empty or non-finite stratum, or no resamples.
    """
    checked = [_checked(values, "strata") for values in strata]
    if not checked or resamples < 1:
        raise ConfigError(f"strata, resamples: {len(checked)}, {resamples}, allowed > 0")
    drawn = [
        values[rng.integers(0, len(values), size=(resamples, len(values)))] for values in checked
    ]
    spread = statistic(drawn)
    low, high = np.percentile(spread, _PERCENTILES)
    value = float(statistic([values[None, :] for values in checked])[0])
    return Interval(value, float(low), float(high), min(len(values) for values in checked))


def iqm_interval(
    values: FloatArray | Sequence[float], rng: np.random.Generator, resamples: int = RESAMPLES
) -> Interval:
    """Interquartile mean of one row's runs, shape (n,), with its interval."""
    return stratified_bootstrap(
        lambda strata: interquartile_mean(strata[0]), [np.asarray(values)], rng, resamples
    )


def ratio_interval(
    upper: FloatArray | Sequence[float],
    lower: FloatArray | Sequence[float],
    rng: np.random.Generator,
    resamples: int = RESAMPLES,
) -> Interval:
    """Interquartile mean of one row over that of another, with its interval.

    Raises:
        ConfigError: a row is empty or not finite, or ``lower`` is not positive throughout.
    """
    below = np.asarray(lower, dtype=np.float64)
    if below.size and below.min() <= 0.0:
        raise ConfigError(f"lower: {below.min():g}, allowed > 0 (it is divided by)")
    return stratified_bootstrap(
        lambda strata: interquartile_mean(strata[0]) / interquartile_mean(strata[1]),
        [np.asarray(upper), below],
        rng,
        resamples,
    )


def difference_interval(
    first: FloatArray | Sequence[float],
    second: FloatArray | Sequence[float],
    rng: np.random.Generator,
    resamples: int = RESAMPLES,
) -> Interval:
    """Interquartile mean of one row minus that of another, with its interval."""
    return stratified_bootstrap(
        lambda strata: interquartile_mean(strata[0]) - interquartile_mean(strata[1]),
        [np.asarray(first), np.asarray(second)],
        rng,
        resamples,
    )


def probability_of_improvement(
    better: FloatArray | Sequence[float],
    worse: FloatArray | Sequence[float],
    rng: np.random.Generator,
    resamples: int = RESAMPLES,
) -> Interval:
    """Probability that a run of ``better`` exceeds one of ``worse``, ties half (Mann-Whitney)."""
    x, y = _checked(better, "better"), _checked(worse, "worse")
    return pairwise_probability(0.5 + 0.5 * np.sign(x[:, None] - y[None, :]), rng, resamples)


def pairwise_probability(
    wins: FloatArray, rng: np.random.Generator, resamples: int = RESAMPLES
) -> Interval:
    """Mean of a table of wins, with the interval from resampling its rows and its columns.

    Args:
        wins: 1 where run i of the first row beats run j of the second, 0.5 for a tie, shape
            (n_1, n_2).
    """
    table = _checked(wins, "wins")
    first = rng.integers(0, table.shape[0], size=(resamples, table.shape[0]))
    second = rng.integers(0, table.shape[1], size=(resamples, table.shape[1]))
    spread = table[first[:, :, None], second[:, None, :]].mean(axis=(1, 2))
    low, high = np.percentile(spread, _PERCENTILES)
    return Interval(float(table.mean()), float(low), float(high), min(table.shape))


def iqm_band(
    curves: FloatArray, rng: np.random.Generator, resamples: int = RESAMPLES
) -> CurveBand:
    """Interquartile mean over seeds at every point, with its interval.

    Args:
        curves: shape (S, K), finite; thin long ones, 40,000 points take 12 s. All points share
            the resampled seeds.
    """
    data = _checked(curves, "curves")
    if data.ndim != 2:
        raise ConfigError(f"curves: {data.ndim} axes, allowed 2 (seeds, points)")
    seeds, points = data.shape
    drawn = rng.integers(0, seeds, size=(resamples, seeds))
    low, high = np.empty(points), np.empty(points)
    for begin in range(0, points, _CHUNK):  # resamples x seeds x points would not fit in memory
        part = slice(begin, begin + _CHUNK)
        spread = interquartile_mean(data[drawn, part], axis=1)
        low[part], high[part] = np.percentile(spread, _PERCENTILES, axis=0)
    return CurveBand(interquartile_mean(data, axis=0), low, high, seeds)


def pearson(x: FloatArray, y: FloatArray) -> float | None:
    """Pearson's correlation; None where it is undefined: under two points, or no variance.

    Raises:
        ConfigError: lengths differ, or a value is not finite.
    """
    if np.shape(x) != np.shape(y):
        raise ConfigError(f"x, y: shapes {np.shape(x)} and {np.shape(y)}, allowed equal shapes")
    if np.size(x) < 2:
        return None
    a, b = _checked(x, "x").ravel(), _checked(y, "y").ravel()
    a, b = _centred(a), _centred(b)
    scale = float(np.sqrt(a @ a) * np.sqrt(b @ b))
    if scale == 0.0:
        return None
    return float(np.clip(a @ b / scale, -1.0, 1.0))


def strength_of(r: float | None) -> str:
    """The paper's words for a correlation: "weak negative correlation" and so on.

    Raises:
        ConfigError: r is outside -1..1.
    """
    if r is None:
        return "undefined"
    if not -1.0 <= r <= 1.0:
        raise ConfigError(f"r: {r}, allowed -1..1")
    if r == 0.0:
        return "no correlation"
    size = abs(r)
    strength = "perfect"
    if size < 1.0:
        strength = next(name for least, name in PEARSON_SCALE if size >= least)
    return f"{strength} {'positive' if r > 0 else 'negative'} correlation"


_PERCENTILES = (50.0 * (1.0 - CONFIDENCE), 50.0 * (1.0 + CONFIDENCE))


def _centred(values: FloatArray) -> FloatArray:
    """Minus the mean, scaled to at most 1; zero where all that is left is rounding."""
    centred = values - values.mean()
    largest = float(np.abs(centred).max())
    if largest <= 1e-12 * float(np.abs(values).max()):
        return np.zeros_like(centred)
    scaled: FloatArray = centred / largest
    return scaled


def _checked(values: FloatArray | Sequence[float], name: str) -> FloatArray:
    data = np.asarray(values, dtype=np.float64)
    if data.size == 0 or data.ndim == 0:
        raise ConfigError(f"{name}: {data.size} values on {data.ndim} axes, allowed 1 or more")
    if not np.isfinite(data).all():
        raise ConfigError(f"{name}: a value is not finite, allowed finite numbers")
    return data
