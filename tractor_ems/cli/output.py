"""How results reach people (tables) and programs (one JSON document on stdout)."""

import json
import math
from collections.abc import Sequence
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

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
    Console().print(table)


def shown(value: Any) -> str:
    """A cell as text."""
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        if not math.isfinite(value):
            return str(value)
        return f"{value:.4f}" if abs(value) < 100 else f"{value:,.0f}"
    return str(value)


RESULT_COLUMNS = (
    "policy",
    "cycle",
    "fuel kg",
    "fuel gal",
    "efficiency",
    "final SOC",
    "target",
    "starts",
    "dp_ratio",
    "violations",
)


def result_row(result: dict[str, Any]) -> tuple[Any, ...]:
    """The cells of one result under RESULT_COLUMNS."""
    return (
        result["policy"],
        result["cycle"] + (" (held out)" if result["held_out"] else ""),
        result["fuel_kg"],
        result["fuel_gal"],
        result["efficiency"],
        result["soc_final"],
        result["soc_target"],
        result["engine_starts"],
        result["dp_ratio"],
        result["violations"],
    )
