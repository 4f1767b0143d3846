"""Duty cycles as CSV, ``time_s,power_demand_w`` at equal steps.

Strict on purpose: a file that is not an even series of numbers is refused with the line that is
wrong, and ``ems cycle import`` repairs it with an account of what that changed.
"""

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tractor_msgs_py.atomic import write_bytes
from tractor_msgs_py.errors import CycleError
from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.duty_cycle.cycle import DEMAND_LIMIT_W, DutyCycle

COLUMNS = ("time_s", "power_demand_w")

SHOWN = 80
"""Characters of a foreign text that a message repeats."""


def quoted(text: str) -> str:
    """A foreign text for a message: quoted, unprintable characters escaped, cut."""
    whole = repr(text)
    return whole if len(whole) <= SHOWN else whole[:SHOWN] + "..."


def read_rows(path: Path) -> tuple[list[int], list[tuple[str, str]]]:
    """Line numbers and the two columns as text; other columns are ignored.

    Raises:
        CycleError: the file cannot be read, is no CSV, or has a column not once.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            lines, rows = [], []
            _check_header(path, reader.fieldnames)
            for row in reader:
                lines.append(reader.line_num)
                rows.append((row["time_s"] or "", row["power_demand_w"] or ""))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise CycleError(f"{path}: cannot be read ({error})") from None
    return lines, rows


def _check_header(path: Path, names: Sequence[str] | None) -> None:
    if names is None:  # an empty file: it has no rows, which is refused later
        return
    for name in COLUMNS:
        count = list(names).count(name)
        if count > 1:
            raise CycleError(f"{path}:1: column {name} is there {count} times, allowed once")
        if count == 0:
            header = ",".join(names)
            separators = [s for s in (";", "\t") if s in header]
            why = f" (separated by {separators[0]!r}, must be a comma)" if separators else ""
            raise CycleError(f"{path}:1: column {name} is missing, has {quoted(header)}{why}")


def read_cycle_csv(path: Path) -> DutyCycle:
    """A cycle from CSV with the columns ``time_s,power_demand_w`` at equal steps.

    Raises:
        CycleError: the file is missing or empty, lacks a column, holds something that is not a
            finite number, power beyond ``DEMAND_LIMIT_W``, or time that does not advance by
            equal steps of at most 60 s; the message names file, line, value and what is allowed.
    """
    lines, rows = read_rows(path)
    if len(rows) < 2:
        where = f"{path}:{lines[0]}" if rows else str(path)
        many = "1 row" if rows else "0 rows"
        raise CycleError(f"{where}: {many}, at least 2 are needed to know the step")
    time_s = _numbers(path, lines, COLUMNS[0], [row[0] for row in rows])
    demand_w = _numbers(path, lines, COLUMNS[1], [row[1] for row in rows])
    return DutyCycle(path.stem, demand_w, _step_s(path, lines, time_s), "csv", source=str(path))


def write_cycle_csv(path: Path, cycle: DutyCycle) -> None:
    """Write a cycle whole or not at all; reading it gives the same demand to the bit.

    Raises:
        CycleError: the cycle has one sample, whose step no reader could know.
        ConfigError: the folder cannot be written to.
    """
    if len(cycle) < 2:
        raise CycleError(f"{path}: cycle {cycle.name} has 1 sample, a file needs at least 2")
    rows = [
        f"{_plain(round(k * cycle.dt_s, 6))},{_plain(power)}\n"
        for k, power in enumerate(cycle.power_demand_w.tolist())
    ]
    write_bytes(path, (",".join(COLUMNS) + "\n" + "".join(rows)).encode())


def _plain(value: float) -> str:
    """Shortest text that reads back as the same float; whole numbers without a point."""
    return str(int(value)) if value.is_integer() else repr(value)


def _numbers(path: Path, lines: list[int], name: str, cells: list[str]) -> FloatArray:
    values = np.empty(len(cells))
    limit = DEMAND_LIMIT_W if name == "power_demand_w" else np.inf
    for k, cell in enumerate(cells):
        try:
            values[k] = float(cell)
        except ValueError:
            raise CycleError(
                f"{path}:{lines[k]}: {name} is {quoted(cell)}, not a number"
            ) from None
        if not (np.isfinite(values[k]) and abs(values[k]) <= limit):
            allowed = f"-{limit:.0f}..{limit:.0f} W" if np.isfinite(limit) else "finite"
            raise CycleError(
                f"{path}:{lines[k]}: {name} is {cell.strip()[:SHOWN]}, allowed {allowed} "
                "(ems cycle import drops such rows)"
            )
    return values


def _step_s(path: Path, lines: list[int], time_s: FloatArray) -> float:
    """The step of an even time axis to the microsecond.

    Times since 1970 resolve 0.2 us as float64, so evenness is judged no finer than that.
    """
    dt_s = float(time_s[-1] - time_s[0]) / (len(time_s) - 1)
    even = time_s[0] + dt_s * np.arange(len(time_s))
    tolerance_s = max(1e-6 * dt_s, 4 * float(np.spacing(np.abs(time_s).max())))
    if dt_s > 0 and np.all(np.abs(time_s - even) <= tolerance_s):
        if 0 < round(dt_s, 6) <= 60:
            return round(dt_s, 6)
        raise CycleError(
            f"{path}:{lines[1]}: time_s advances by {dt_s:.6g}, allowed steps of 1e-06..60 s"
        )
    step_s = np.diff(time_s)
    # Of two the lower: between a step and a leap lies no step at all.
    forward_s = step_s[step_s > 0]
    usual_s = float(np.quantile(forward_s, 0.5, method="lower")) if len(forward_s) else 0.0
    odd = np.flatnonzero((step_s <= 0) | (np.abs(step_s - usual_s) > max(1e-6, tolerance_s)))
    k = int(odd[0]) + 1 if len(odd) else len(time_s) - 1
    raise CycleError(
        f"{path}:{lines[k]}: time_s is {time_s[k]:.9g} after {time_s[k - 1]:.9g}, allowed equal "
        f"steps > 0 (ems cycle import resamples an uneven recording)"
    )
