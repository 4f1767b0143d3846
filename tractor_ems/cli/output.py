"""How results reach people (tables) and programs (one JSON document on stdout)."""

import json
import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from tractor_ems.result import NOT_ASKED_FOR
from tractor_ems.summary import summarise_policies

JsonFlag = Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")]

NOTES = Console(stderr=True)
"""Progress and remarks; stdout is for results."""


def print_json(document: Any) -> None:
    """Print one JSON document; a number that is not finite is a bug and raises ValueError."""
    print(json.dumps(document, indent=2, allow_nan=False))


def print_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """Print one table; floats to four significant places, None as a dash."""
    table = Table(title=title, title_justify="left")
    for position, column in enumerate(columns):
        table.add_column(column, justify="left" if position == 0 else "right")
    for row in rows:
        table.add_row(*(shown(value) for value in row))
    # A pipe or a narrow log gets whole cells rather than cut ones.
    Console(width=None if sys.stdout.isatty() else 240).print(table)


def shown(value: Any) -> str:
    """A cell as text."""
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        if not math.isfinite(value):
            return str(value)
        return f"{value:.4f}" if 1e-3 <= abs(value) < 100 or value == 0 else f"{value:.4g}"
    if isinstance(value, list) and len(value) > 6:
        return f"{len(value)} of them"
    return str(value)


def print_result(result: dict[str, Any]) -> None:
    """Print one result, a quantity a line; nested objects by dotted name."""
    print_table("", ("quantity", "value"), list(_flat(result)))


RUN_COLUMNS = {
    "cycle": ("cycle", ""),
    "policy": ("policy", ""),
    "fuel_kg": ("fuel kg", ".3f"),
    "fuel_l_per_h": ("L/h", ".2f"),
    "fuel_l_per_ha": ("L/ha", ".2f"),
    "efficiency": ("eff.", ".3f"),
    "engine_starts": ("starts", "d"),
    "engine_h": ("on h", ".3f"),
    "below_60kw_s": ("<60kW s", ".0f"),
    "equivalent_full_cycles": ("full cyc.", ".3f"),
    "soc_final": ("SOC end", ".3f"),
    "soc_excursion": ("SOC span", ".3f"),
    "shortfall_j": ("short J", ".0f"),
    "violations": ("viol.", "d"),
    "dp_ratio": ("dp_ratio", ".4f"),
}
"""Keys of a result that a table of many runs shows, their headings and formats."""

SUMMARY_COLUMNS = {
    "policy": ("policy", ""),
    "runs": ("runs", "d"),
    "not_driven": ("not driven", "d"),
    "short": ("short", "d"),
    "scored": ("scored", "d"),
    "dp_ratio_median": ("dp_ratio median", ".4f"),
    "dp_ratio_worst": ("worst", ".4f"),
    "worst_cycle": ("on", ""),
    "fuel_l_per_h": ("median L/h", ".2f"),
    "starts_per_h": ("median starts/h", ".1f"),
    "soc_deviation": ("worst SOC end - target", "+.3f"),
    "violations": ("violations", "d"),
}
"""The same for the summary of a policy."""


def print_runs(rows: Sequence[Mapping[str, Any]]) -> None:
    """Print many results: a row each, notes on those that DP could not score, a summary per
    policy."""
    _print_columns("", RUN_COLUMNS, rows)
    for row in rows:
        if row["dp_ratio"] is None and row["dp_note"] != NOT_ASKED_FOR:
            NOTES.print(
                f"{row['policy']} on {row['cycle']}: no dp_ratio, {row['dp_note']}",
                markup=False,
                highlight=False,
                soft_wrap=True,
            )
    summaries = [asdict(summary) for summary in summarise_policies(rows)]
    _print_columns("per policy", SUMMARY_COLUMNS, summaries)


def _print_columns(
    title: str, columns: Mapping[str, tuple[str, str]], rows: Sequence[Mapping[str, Any]]
) -> None:
    cells = [
        [None if row[key] is None else format(row[key], how) for key, (_, how) in columns.items()]
        for row in rows
    ]
    print_table(title, [heading for heading, _ in columns.values()], cells)


def _bars() -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=NOTES,
        disable=not NOTES.is_terminal,
    )


@contextmanager
def counting(what: str, total: int) -> Iterator[Callable[[int], None]]:
    """A bar on stderr that is told how many are done; nothing where stderr is no terminal."""
    with _bars() as bar:
        task = bar.add_task(what, total=total)
        yield lambda done: bar.update(task, completed=done)


@contextmanager
def stages() -> Iterator[Callable[[str, int, int], None]]:
    """A bar per stage on stderr, told its name, how many are done and how many there are."""
    with _bars() as bar:
        tasks: dict[str, TaskID] = {}

        def show(what: str, done: int, total: int) -> None:
            if what not in tasks:
                tasks[what] = bar.add_task(what, total=total)
            bar.update(tasks[what], completed=done)

        yield show


def _flat(document: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in document.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value
