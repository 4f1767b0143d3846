"""What the measuring scripts beside it share: quantiles, the machine, and sections that become
one table on the screen, one JSON file and one place in docs/measured.md."""

import json
import os
import platform
import shlex
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from tractor_msgs_py.atomic import write_json

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / "test"))  # where the tests find `nodes`, and the scripts too
WIDTH = 130
DATA = ROOT / "docs" / "data" / "measured.json"


@dataclass(frozen=True)
class Section:
    """One measurement.

    Attributes:
        title: what was measured.
        columns, rows: the table, as text.
        figures: the raw numbers behind it.
        notes: what a reader must know, failures first.
    """

    title: str
    columns: tuple[str, ...]
    rows: list[tuple[str, ...]]
    figures: dict[str, Any]
    notes: list[str] = field(default_factory=list)


def quantiles(values: Sequence[float], scale: float = 1.0) -> dict[str, float]:
    """Least, middle, 99 % and greatest; the 99 % one is a value that occurred."""
    array = np.sort(np.asarray(values, dtype=np.float64)) * scale
    if not array.size:
        return {}
    near = float(np.quantile(array, 0.99, method="higher"))
    return {
        "min": round(float(array[0]), 4),
        "p50": round(float(np.median(array)), 4),
        "p99": round(near, 4),
        "max": round(float(array[-1]), 4),
    }


def shown(found: dict[str, float], *names: str, digits: int = 3) -> tuple[str, ...]:
    """Quantiles as text, a dash where nothing was measured."""
    return tuple(f"{found[name]:.{digits}f}" if found else "-" for name in names)


def machine() -> dict[str, Any]:
    """What the figures were measured on and how busy it was with other work."""
    return {
        "cores": os.cpu_count(),
        "processor": _processor(),
        "python": platform.python_version(),
        "load_before": round(os.getloadavg()[0], 1),
    }


def _command() -> str:
    """The command line without what only says where to put the figures."""
    given, kept = list(sys.argv), [f"python test/nodes/{Path(sys.argv[0]).name}"]
    for before, word in pairwise(given):
        if "--out" not in (before, word):
            kept.append(shlex.quote(word))
    return " ".join(kept)


def _processor() -> str:
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            return " ".join(line.partition(":")[2].split())
    return platform.machine()


def publish(
    section: Section, before: dict[str, Any], out: Path | None, record: str | None
) -> None:
    """Show a section, write it to ``out``, and keep it for docs/measured.md as ``record``."""
    table = Table(title=section.title)
    for column in section.columns:
        table.add_column(column)
    for row in section.rows:
        table.add_row(*row)
    console = Console(width=WIDTH, soft_wrap=True)
    console.print(table)
    for note in section.notes:
        console.print(note, markup=False)
    document = {
        **asdict(section),
        "command": _command(),
        "date": time.strftime("%Y-%m-%d"),
        "machine": before | {"load_after": round(os.getloadavg()[0], 1)},
    }
    if out is not None:
        write_json(out, document)
    if record is not None:
        kept = json.loads(DATA.read_text()) if DATA.exists() else {}
        write_json(DATA, kept | {record: document})
