"""Many plants at once, compiled: tables from a powertrain, and steps over arrays in place.

For learners and searches that need millions of steps. One plant, or a result that somebody reads,
goes through ``tractor_sim.powertrain``, which this is tested against.
"""

import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.trajectory import BoolArray, FloatArray
from tractor_sim.batch_kernel import Curve, Plant, Segments, drive_range, limits_of, step_range
from tractor_sim.generator import knots_w
from tractor_sim.powertrain import (
    ROUNDING_W,
    Command,
    PlantState,
    PowerLimits,
    PowertrainParams,
    StepResult,
)

_BINS_MAX = 1 << 17
"""Most bins of a curve: half a megabyte."""


class BatchPlant(NamedTuple):
    """A powertrain for the compiled step; see ``batch_kernel`` for the fields."""

    plant: Plant
    knots: FloatArray
    segments: Segments


@lru_cache(maxsize=32)
def batch_plant(params: PowertrainParams) -> BatchPlant:
    """The numbers and tables of a powertrain; the same object for equal powertrains."""
    engine, battery, generator = params.engine, params.battery, params.generator
    crank_w, bus_w = knots_w(generator, engine.power_max_w)
    engine_y = np.array(engine.curve_fuel_kg_per_s or engine.curve_efficiency)
    ocv_soc, ocv_v = battery.ocv_soc or (0.0, 1.0), battery.ocv_v or (battery.voltage_v,) * 2
    (curve, bus_of_crank, crank_of_bus, ocv), knots, segments = _tables(
        (np.array(engine.curve_power_w), engine_y),
        (crank_w, bus_w),
        (bus_w, crank_w),
        (np.array(ocv_soc), np.array(ocv_v)),
    )
    plant = Plant(
        dt_s=params.dt_s,
        rounding_w=ROUNDING_W,
        power_max_w=engine.power_max_w,
        lhv_j_per_kg=engine.fuel_lhv_j_per_kg,
        idle_fuel_kg_per_s=engine.idle_fuel_kg_per_s,
        start_fuel_kg=engine.start_fuel_kg,
        min_on_s=engine.min_on_s,
        min_off_s=engine.min_off_s,
        ramp_w=engine.ramp_w_per_s * params.dt_s,
        fuel_curve=bool(engine.curve_fuel_kg_per_s),
        curve=curve,
        bus_of_crank=bus_of_crank,
        crank_of_bus=crank_of_bus,
        lossless=battery.lossless,
        energy_j=battery.energy_j,
        charge_c=battery.charge_c,
        battery_max_w=battery.power_max_w,
        soc_min=battery.soc_min,
        soc_max=battery.soc_max,
        ocv=ocv,
        resistance_ohm=battery.resistance_ohm,
        charge_max_a=battery.current_max_charge_a,
        discharge_max_a=battery.current_max_discharge_a,
    )
    return BatchPlant(plant, knots, segments)


def _tables(
    *curves: tuple[FloatArray, FloatArray],
) -> tuple[list[Curve], FloatArray, Segments]:
    """The curves in one table of knots (x, y, slope) and one of segments."""
    placed, knots, segments, row, place = [], [], [], 0, 0
    for x, y in curves:
        # Bins of less than half the least distance of two knots: a look-up moves on once at most,
        # even where rounding put it into the bin before.
        bins = int(2.0 * (x[-1] - x[0]) / np.min(np.diff(x))) + 1
        if bins > _BINS_MAX:
            raise ConfigError(
                f"powertrain: two knots of a curve are {np.min(np.diff(x)):g} apart on "
                f"{x[0]:g}..{x[-1]:g}, the compiled plant allows 1/{_BINS_MAX // 2} of that range"
            )
        per_x = bins / (x[-1] - x[0])
        # Edges a little to the left: a look-up only goes up, it must not begin too far.
        edges = x[0] + (np.arange(bins + 1) - 1e-6) / per_x
        found = np.clip(np.searchsorted(x, edges, side="right") - 1, 0, len(x) - 2)
        slope = np.append(np.diff(y) / np.diff(x), 0.0)
        ends = (float(x[0]), float(x[-1]))
        placed.append(Curve(*ends, place, float(per_x)))
        # The last row is for a look-up at the last knot, which asks for the one after it.
        knots += [np.column_stack((x, y, slope, slope)), np.array([[np.inf, 0.0, 0.0, 0.0]])]
        segments.append(found + row)
        row, place = row + len(x) + 1, place + bins + 1
    return placed, np.concatenate(knots).ravel(), np.concatenate(segments).astype(np.uint32)


def empty_result(batch: int) -> StepResult:
    """Arrays of B plants for :func:`step_batch` to write to."""
    numbers = [np.zeros(batch) for _ in range(5)]
    flags = [np.zeros(batch, dtype=bool) for _ in range(2)]
    battery_w, engine_w, fuel_kg, shortfall_j, dissipated_j = numbers
    return StepResult(battery_w, engine_w, fuel_kg, flags[0], shortfall_j, dissipated_j, flags[1])


def step_batch(
    plant: BatchPlant,
    state: PlantState,
    power_demand_w: FloatArray,
    command: Command,
    result: StepResult,
    *,
    threads: int = 1,
) -> None:
    """``powertrain.step`` of B plants, in place.

    Args:
        plant: of :func:`batch_plant`.
        state: overwritten by the next state; every array (B,), contiguous.
        power_demand_w: finite demand at the bus, auxiliaries included, (B,) [W].
        command: (B,), as for ``powertrain.step``; any value is survived.
        result: overwritten by what was applied, see :func:`empty_result`.
        threads: that share the batch.

    Raises:
        ValueError: an array has another shape.
    """
    columns: tuple[Any, ...] = (
        state.soc,
        state.engine_on,
        state.time_in_state_s,
        state.engine_power_w,
        power_demand_w,
        command.battery_power_w,
        command.engine_power_w,
        result.battery_power_w,
        result.engine_power_w,
        result.fuel_kg,
        result.engine_started,
        result.shortfall_j,
        result.dissipated_j,
        result.refused,
    )
    _check_shape(state.soc.shape, columns)
    _share(len(state.soc), threads, lambda begin, end: step_range(*plant, begin, end, *columns))


@dataclass(frozen=True)
class DriveTotals:
    """Sums over T steps of B plants, every array of shape (B,)."""

    fuel_kg: FloatArray
    starts: FloatArray
    shortfall_j: FloatArray
    dissipated_j: FloatArray
    refused: FloatArray


def drive_batch(
    plant: BatchPlant,
    state: PlantState,
    power_demand_w: FloatArray,
    command: Command,
    *,
    threads: int = 1,
) -> DriveTotals:
    """T steps of B plants.

    Args:
        plant, threads: as for :func:`step_batch`.
        state: (B,), overwritten by the state after the last step.
        power_demand_w: finite, (T, B), contiguous [W].
        command: (T, B).

    Returns:
        The sums over the T steps.

    Raises:
        ValueError: an array has another shape.
    """
    batch = len(state.soc)
    totals = DriveTotals(*(np.zeros(batch) for _ in range(5)))
    columns = (state.soc, state.engine_on, state.time_in_state_s, state.engine_power_w)
    inputs = (power_demand_w, command.battery_power_w, command.engine_power_w)
    sums = (
        totals.fuel_kg,
        totals.starts,
        totals.shortfall_j,
        totals.dissipated_j,
        totals.refused,
    )
    arrays: tuple[Any, ...] = (*columns, *inputs, *sums)
    _check_shape((batch,), columns)
    _check_shape((len(power_demand_w), batch), inputs)

    def drive(begin: int, end: int) -> None:
        drive_range(*plant, begin, end, *arrays)

    _share(batch, threads, drive)
    return totals


def limits_batch(plant: BatchPlant, state: PlantState) -> PowerLimits:
    """``powertrain.power_limits`` of B plants.

    Raises:
        ValueError: an array has another shape.
    """
    columns = (state.soc, state.engine_on, state.time_in_state_s, state.engine_power_w)
    _check_shape(state.soc.shape, columns)
    charge_w, discharge_w, engine_w, least_w, ocv_v = np.empty((5, len(state.soc)))
    may_be_off: BoolArray = np.empty(len(state.soc), dtype=bool)
    into: tuple[Any, ...] = (charge_w, discharge_w, engine_w, least_w, may_be_off, ocv_v)
    arrays: tuple[Any, ...] = (*columns, *into)
    limits_of(*plant, *arrays)
    return PowerLimits(charge_w, discharge_w, engine_w, least_w, may_be_off)


def _check_shape(shape: tuple[int, ...], columns: tuple[NDArray[Any], ...]) -> None:
    # Compiled code does not check its indices: a short array would be read beyond its end.
    for column in columns:
        if column.shape != shape:
            raise ValueError(f"an array of shape {column.shape}, allowed {shape}")


@lru_cache(maxsize=8)
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="plant")


def _share(batch: int, threads: int, work: Callable[[int, int], None]) -> None:
    """Call ``work(begin, end)`` on equal parts of the batch, the last one on this thread."""
    edges = np.linspace(0, batch, max(1, min(threads, batch)) + 1).astype(int).tolist()
    *others, last = itertools.pairwise(edges)
    waiting = [_pool(threads).submit(work, *part) for part in others]
    work(*last)
    for future in waiting:
        future.result()
