"""What the runs cost, and what the code does on a machine of its own where that was measured."""

from collections.abc import Callable, Sequence

import numpy as np

from tractor_ems.study.results import Run, StudyResults
from tractor_ems.study.tables.measures import soc_min_text
from tractor_ems.study.tables.table import Table

OVERLAPPED = (
    "Seconds are wall time of runs that overlapped with other runs, and other work, on a shared "
    "machine: rates are lower bounds of what the code does, and the sum is not processor time."
)


def cost_tables(results: StudyResults) -> tuple[Table, ...]:
    """Cost of every row; and speeds, where the provenance has any."""
    speeds = speed_table(results)
    return (_cost(results), *([] if speeds is None else [speeds]))


def speed_table(results: StudyResults) -> Table | None:
    """``provenance["speed"]``: what was timed on the quiet machine, per second."""
    measured = results.provenance.get("speed")
    if not measured:
        return None
    return Table(
        "speed",
        "Speed",
        "Timed by themselves, apart from the runs of the study.",
        ("what", "per second", "unit"),
        tuple((str(m["what"]), f"{m['per_s']:,.0f}", str(m["unit"])) for m in measured),
    )


def _cost(results: StudyResults) -> Table:
    rows = []
    for row in results.rows:
        runs = results.of(row.key)
        seconds = [max(run.seconds, 1e-9) for run in runs]
        rows.append(
            (
                row.label,
                soc_min_text(row.soc_min),
                str(len(runs)),
                _range([run.episodes for run in runs]),
                _range([run.steps for run in runs]),
                _range([run.updates for run in runs]),
                _rate(runs, seconds, lambda run: run.steps),
                _rate(runs, seconds, lambda run: run.updates),
                f"{np.median(seconds):,.0f}",
                f"{sum(seconds) / 3600:.2f}",
                f"{max(run.peak_rss_bytes for run in runs) / 1e6:,.0f}",
            )
        )
    total_h = sum(run.seconds for run in results.runs) / 3600
    return Table(
        "cost",
        "Cost",
        f"{OVERLAPPED} Evaluations are included; rates and time per run are medians over seeds. "
        "Memory is the peak of the process a run was in, which may have held another run before: "
        "at most this.",
        (
            "row",
            "SOC_min",
            "seeds",
            "episodes",
            "transitions",
            "updates",
            "transitions per wall second",
            "updates per wall second",
            "wall per run [s]",
            "wall, sum over seeds [h]",
            "peak memory of its process, at most [MB]",
        ),
        tuple(rows),
        (f"{len(results.runs)} runs; their wall times add up to {total_h:.2f} h.",),
    )


def _rate(runs: Sequence[Run], seconds: Sequence[float], count: Callable[[Run], int]) -> str:
    return f"{np.median([count(run) / s for run, s in zip(runs, seconds, strict=True)]):,.0f}"


def _range(values: Sequence[int]) -> str:
    low, high = min(values), max(values)
    return f"{low:,}" if low == high else f"{low:,}-{high:,}"
