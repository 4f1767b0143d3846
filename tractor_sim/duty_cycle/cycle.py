"""A duty cycle: power demand at equal steps, without the plant's own auxiliaries."""

import csv
import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from tractor_msgs_py.errors import CycleError
from tractor_msgs_py.trajectory import FloatArray

Split = Literal["train", "validation", "held_out"]


@dataclass(frozen=True)
class DutyCycle:
    """Demand over T steps.

    Attributes:
        name: short name.
        power_demand_w: shape (T,), held over each step; negative is valid [W].
        dt_s: step length [s].
        operation: the kind of work, for instance ``planter``.
        split: what the cycle may be used for; None for a user's own.
        seed: generator seed; None where there is none.
        source: where it comes from, for a reader.
        area_ha: field area worked over the whole cycle [ha]; None where it is not field work or
            width and speed are unknown. Not part of the hash.
    """

    name: str
    power_demand_w: FloatArray
    dt_s: float
    operation: str
    split: Split | None = None
    seed: int | None = None
    source: str = ""
    area_ha: float | None = None

    def __post_init__(self) -> None:
        demand = self.power_demand_w
        if demand.ndim != 1 or len(demand) < 1:
            raise CycleError(f"cycle {self.name}: has no samples")
        bad = np.flatnonzero(~np.isfinite(demand) | (np.abs(demand) > 1e9))
        if len(bad):
            raise CycleError(
                f"cycle {self.name}: power_demand_w is {demand[bad[0]]} at sample {bad[0]}, "
                "allowed finite and within +-1e9 W"
            )
        if not (np.isfinite(self.dt_s) and 0 < self.dt_s <= 60):
            raise CycleError(f"cycle {self.name}: dt_s {self.dt_s}, allowed 0 < dt_s <= 60")
        if self.area_ha is not None and not (np.isfinite(self.area_ha) and self.area_ha >= 0):
            raise CycleError(f"cycle {self.name}: area_ha {self.area_ha}, allowed finite and >= 0")

    def __len__(self) -> int:
        return len(self.power_demand_w)


def cycle_hash(cycle: DutyCycle) -> str:
    """SHA-256 of step length and demand; name, source and area do not count."""
    digest = hashlib.sha256()
    digest.update(np.float64(cycle.dt_s).astype("<f8").tobytes())
    digest.update((cycle.power_demand_w + 0.0).astype("<f8").tobytes())
    return digest.hexdigest()


def read_cycle_csv(path: Path) -> DutyCycle:
    """A cycle from CSV with the columns ``time_s,power_demand_w`` at equal steps.

    Raises:
        CycleError: the file is missing or empty, lacks a column, holds something that is not a
            finite number, or its time does not advance by equal steps.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise CycleError(f"{path}: cannot be read ({error})") from None
    if len(rows) < 2:
        raise CycleError(f"{path}: {len(rows)} rows, at least 2 are needed")
    columns: dict[str, FloatArray] = {}
    for name in ("time_s", "power_demand_w"):
        values = []
        for number, row in enumerate(rows, start=2):
            if name not in row:
                raise CycleError(f"{path}: column {name} is missing, has {list(rows[0])}")
            try:
                values.append(float(row[name] or ""))
            except ValueError:
                raise CycleError(
                    f"{path}:{number}: {name} is {row[name]!r}, not a number"
                ) from None
        columns[name] = np.array(values)
    dt_s = _equal_step_s(columns["time_s"])
    if dt_s is None:
        raise CycleError(f"{path}: time_s must advance by equal steps > 0")
    return DutyCycle(path.stem, columns["power_demand_w"], dt_s, "csv", source=str(path))


def _equal_step_s(time_s: FloatArray) -> float | None:
    """The step of an even time axis to the microsecond, or None.

    Times since 1970 resolve 0.2 us as float64, so evenness is judged no finer than that.
    """
    if not np.all(np.isfinite(time_s)):
        return None
    dt_s = float(time_s[-1] - time_s[0]) / (len(time_s) - 1)
    even = time_s[0] + dt_s * np.arange(len(time_s))
    tolerance_s = max(1e-6 * dt_s, 4 * float(np.spacing(np.abs(time_s).max())))
    if dt_s <= 0 or np.any(np.abs(time_s - even) > tolerance_s):
        return None
    return round(dt_s, 6)
