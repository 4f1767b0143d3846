"""A duty cycle: power demand at equal steps, without the plant's own auxiliaries."""

import hashlib
from dataclasses import dataclass
from typing import Literal

import numpy as np

from tractor_msgs_py.errors import CycleError
from tractor_msgs_py.trajectory import FloatArray

Split = Literal["train", "validation", "held_out"]

POWER_LIMIT_W = 1e9
"""No demand is larger either way: what is, is a wrong unit or a broken sensor."""

DEMAND_LIMIT_W = 2e6
"""Largest demand, either way, that is read from a file [W]: several times the largest tractor."""


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
        bad = np.flatnonzero(~np.isfinite(demand) | (np.abs(demand) > POWER_LIMIT_W))
        if len(bad):
            raise CycleError(
                f"cycle {self.name}: power_demand_w is {demand[bad[0]]} at sample {bad[0]}, "
                f"allowed finite and within +-{POWER_LIMIT_W:g} W"
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


def demand_fingerprint(power_demand_w: FloatArray, dt_s: float) -> str:
    """Short hash that a copy of a demand keeps when it is rounded to whole watts or shifted.

    A recording may carry the auxiliaries, a constant, within its demand; the last bit of a
    computed watt depends on the machine. Neither makes a cycle a new one. 16 hex digits.
    """
    steps = np.diff(np.rint(power_demand_w)).astype("<i8")
    return hashlib.sha256(np.float64(dt_s).astype("<f8").tobytes() + steps.tobytes()).hexdigest()[
        :16
    ]
