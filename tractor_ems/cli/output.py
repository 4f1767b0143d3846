"""How results reach people (tables) and programs (one JSON document on stdout)."""

import json
import math
import sys
from collections.abc import Iterator, Sequence
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
    # A pipe or a narrow log gets whole cells rather than cut ones.
    Console(width=None if sys.stdout.isatty() else 160).print(table)


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


def _flat(document: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in document.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value
