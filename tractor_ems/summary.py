"""Many runs: a summary per policy for the terminal, and all rows as CSV."""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from tractor_msgs_py.atomic import write_bytes


@dataclass(frozen=True)
class PolicySummary:
    """One policy over all its runs, ``rows`` of ``Result.to_json``.

    Attributes:
        policy: its name in the rows.
        runs: all of them; scored: those with a dp_ratio.
        not_driven: runs that could not be made; short: runs that left demand unmet. Neither
            has a score, and a policy with any of them has failed there.
        dp_ratio_median, dp_ratio_worst, worst_cycle: over the scored runs; None without any.
        fuel_l_per_h: median of the runs that were driven; starts_per_h: likewise.
        soc_deviation: largest distance of the final SOC from its target, with its sign.
        violations: sum; 0 or a bug.
    """

    policy: str
    runs: int
    scored: int
    not_driven: int
    short: int
    dp_ratio_median: float | None
    dp_ratio_worst: float | None
    worst_cycle: str | None
    fuel_l_per_h: float | None
    starts_per_h: float | None
    soc_deviation: float | None
    violations: int


def summarise_policies(rows: Iterable[Mapping[str, Any]]) -> list[PolicySummary]:
    """A summary per policy, in the order of their first rows."""
    by_policy: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        by_policy.setdefault(row["policy"], []).append(row)
    return [_summary(policy, own) for policy, own in by_policy.items()]


def _summary(policy: str, rows: Sequence[Mapping[str, Any]]) -> PolicySummary:
    driven = [row for row in rows if row["fuel_kg"] is not None]
    scored = [row for row in driven if row["dp_ratio"] is not None]
    worst = min(scored, key=lambda row: row["dp_ratio"], default=None)
    return PolicySummary(
        policy=policy,
        runs=len(rows),
        scored=len(scored),
        not_driven=len(rows) - len(driven),
        short=sum(row["shortfall_j"] > 0.0 for row in driven),
        dp_ratio_median=median(row["dp_ratio"] for row in scored) if scored else None,
        dp_ratio_worst=worst["dp_ratio"] if worst else None,
        worst_cycle=worst["cycle"] if worst else None,
        fuel_l_per_h=median(row["fuel_l_per_h"] for row in driven) if driven else None,
        starts_per_h=median(row["engine_starts_per_h"] for row in driven) if driven else None,
        soc_deviation=max((row["soc_deviation"] for row in driven), key=abs, default=None),
        violations=sum(row["violations"] for row in driven),
    )


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows of equal keys, whole or not at all: a header, floats to the last bit, an empty
    cell for None.

    Raises:
        ConfigError: the folder cannot be written to.
    """
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_bytes(path, text.getvalue().encode())
