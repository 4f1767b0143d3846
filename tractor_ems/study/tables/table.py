"""A table as plain data, and its forms: Markdown, CSV, JSON. No results here."""

import csv
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from tractor_msgs_py.errors import ConfigError


@dataclass(frozen=True)
class Table:
    """Text in rows and columns.

    Attributes:
        name: short, for files and links.
        title: of the section.
        caption: what is shown; no results.
        columns: headings with units, shape (C,).
        rows: cells as shown, shape (R, C); a dash where there is nothing.
        notes: below the table, computed from the same results.

    Raises ConfigError where a row has another number of cells than there are columns.
    """

    name: str
    title: str
    caption: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.columns):
                raise ConfigError(
                    f"table {self.name}: a row of {len(row)} cells, allowed {len(self.columns)}"
                )


def to_markdown(table: Table) -> str:
    """Caption, table and notes, without the title; ends with a line break."""
    lines = [table.caption, ""] if table.caption else []
    lines.append(_line(table.columns))
    columns = zip(*table.rows, strict=True) if table.rows else [()] * len(table.columns)
    marks = (" --: " if _numbers(cells) else " :-- " for cells in columns)
    lines.append("|" + "|".join(marks) + "|")
    lines += [_line(row) for row in table.rows]
    if table.notes:
        lines += ["", *(f"- {note}" for note in table.notes)]
    return "\n".join(lines) + "\n"


def to_csv(table: Table) -> str:
    """Columns and rows as comma-separated values."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(table.columns)
    writer.writerows(table.rows)
    return text.getvalue()


def to_json(table: Table) -> dict[str, Any]:
    """Plain data: rows as objects by column."""
    return {
        "name": table.name,
        "title": table.title,
        "caption": table.caption,
        "rows": [dict(zip(table.columns, row, strict=True)) for row in table.rows],
        "notes": list(table.notes),
    }


def _numbers(cells: Sequence[str]) -> bool:
    """Numbers are read down a column, so they are aligned to the right; text is not."""
    filled = [cell for cell in cells if cell not in ("-", "", "not run", "never")]
    found = sum(bool(_NUMBER.match(cell)) for cell in filled)
    return bool(filled) and 4 * found >= 3 * len(filled)


_NUMBER = re.compile(
    r"(more than )?[+\->]?\s?\d[\d,.]*(-\d[\d,.]*)?( (%|points|kWh|h|s))?( ?[\[(]|, \d+ of |$)"
)
"""A number, with a unit, an interval or a remark after it; neither a mark like "(1)", nor a hash,
a list of numbers or a sentence that begins with one."""


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(_cell(cell) for cell in cells) + " |"


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|") or "-"
