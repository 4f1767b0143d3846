"""How long answers took, in bounded memory: quantiles to within 2 %, the maximum exactly. Pure."""

import math
from collections.abc import Iterable

LEAST_S, GROWTH, BUCKETS = 1e-6, 1.02, 1200
"""Bucket n ends at LEAST_S GROWTH^n: the last one beyond 20000 s."""


class Latencies:
    """Counts durations in buckets that grow by :data:`GROWTH`.

    Attributes:
        count: durations seen.
        max_s: the longest [s], 0 before the first.
    """

    def __init__(self, durations_s: Iterable[float] = ()) -> None:
        self.count, self.max_s = 0, 0.0
        self._buckets = [0] * BUCKETS
        for duration_s in durations_s:
            self.add(duration_s)

    def add(self, duration_s: float) -> None:
        """One duration, >= 0 [s]."""
        self.count += 1
        self.max_s = max(self.max_s, duration_s)
        number = math.ceil(math.log(max(duration_s, LEAST_S) / LEAST_S) / math.log(GROWTH))
        self._buckets[min(number, BUCKETS - 1)] += 1

    def quantile_s(self, share: float) -> float:
        """The duration that ``share`` (0..1) of all did not exceed; 0 before the first [s]."""
        wanted, seen = share * self.count, 0
        for number, bucket in enumerate(self._buckets):
            seen += bucket
            if bucket and seen >= wanted:
                return float(min(LEAST_S * GROWTH**number, self.max_s))
        return self.max_s

    @property
    def summary(self) -> dict[str, float]:
        """p50, p99 and the maximum [s], and how many."""
        return {
            "count": self.count,
            "p50_s": self.quantile_s(0.5),
            "p99_s": self.quantile_s(0.99),
            "max_s": self.max_s,
        }
