"""What a bag holds of a vehicle, step by step: powers at the bus, fuel, battery voltage and
current."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tractor_ems.bags.read import read_bag
from tractor_ems.bags.runs import Run
from tractor_msgs_py.errors import BagError
from tractor_msgs_py.trajectory import BoolArray, FloatArray, IntArray
from tractor_msgs_py.types import RunInfo


@dataclass(frozen=True)
class Recorded:
    """N driven steps of all runs of a bag, every array of shape (N,).

    Attributes:
        info: of the first run.
        runs: how many runs there are.
        stretch: number of the uninterrupted stretch that a step belongs to.
        dt_s: length of the step [s].
        engine_on: during the step; started: in it and not before it.
        engine_w: at the bus [W].
        fuel_kg: of the step, start fuel included.
        soc: at its end, and soc_before: at its beginning.
        voltage_v, current_a: battery at its end, current negative when discharging; NaN where
            they were not recorded.
        engine_limit_w, charge_limit_w, discharge_limit_w: as published before the step [W].
    """

    info: RunInfo
    runs: int
    stretch: IntArray
    dt_s: FloatArray
    engine_on: BoolArray
    started: BoolArray
    engine_w: FloatArray
    fuel_kg: FloatArray
    soc: FloatArray
    soc_before: FloatArray
    voltage_v: FloatArray
    current_a: FloatArray
    engine_limit_w: FloatArray
    charge_limit_w: FloatArray
    discharge_limit_w: FloatArray

    def __len__(self) -> int:
        return len(self.dt_s)


_COLUMNS = tuple(field.name for field in dataclasses.fields(Recorded))[2:]


def read_recorded(bag: Path) -> Recorded:
    """The driven steps of a bag.

    Raises:
        BagError: the bag cannot be read, holds demand alone, or runs of several powertrains.
    """
    runs = [run for run in read_bag(bag) if run.info is not None and any(run.driven)]
    infos = [run.info for run in runs if run.info is not None]
    if not infos:
        raise BagError(f"{bag}: demand alone, no states of engine and battery to fit to")
    kinds = {info.powertrain_hash: info.powertrain for info in infos}
    if len(kinds) > 1:
        raise BagError(f"{bag}: runs of {len(kinds)} powertrains, expected one of them")
    rows: list[tuple[float, ...]] = []
    stretch = 0
    for run in runs:
        stretch = _add(rows, run, stretch + 1)
    columns = dict(zip(_COLUMNS, np.array(rows, dtype=np.float64).T, strict=True))
    for name, kind in (("stretch", np.int64), ("engine_on", bool), ("started", bool)):
        columns[name] = columns[name].astype(kind)
    return Recorded(info=infos[0], runs=len(runs), **columns)


def _add(rows: list[tuple[float, ...]], run: Run, stretch: int) -> int:
    """Append a run's steps; returns the last stretch's number."""
    info = run.info
    assert info is not None
    gap = False
    for stamp, end, driven in zip(run.stamps_ns, run.ends_ns, run.driven, strict=True):
        if not driven:
            gap = True
            continue
        stretch, gap = stretch + gap, False
        before, after = run.powertrain[stamp], run.powertrain[end]
        battery = run.battery[end]
        rows.append(
            (
                stretch,
                info.dt_s,
                after.engine_on,
                after.engine_on and not before.engine_on,
                after.applied_engine_power_w,
                after.fuel_kg,
                battery.soc,
                run.battery[stamp].soc,
                battery.voltage_v,
                battery.current_a,
                before.engine_limit_w,
                before.charge_limit_w,
                before.discharge_limit_w,
            )
        )
    return stretch
