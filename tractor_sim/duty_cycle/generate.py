"""Duty cycles from physics: an operation and a seed in, seconds of bus demand out.

The demand is that of wheels, PTO and hydraulics, without the plant's own auxiliaries; negative
where downhill or braking gives power back. Numbers are in config/cycle/operations.yaml, the
method in docs/duty-cycles.md.
"""

import zlib
from typing import NamedTuple

import numpy as np

from tractor_msgs_py.errors import CycleError
from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.duty_cycle.cycle import DutyCycle
from tractor_sim.duty_cycle.field_work.field import draw_field
from tractor_sim.duty_cycle.field_work.limits import drive_within_limits
from tractor_sim.duty_cycle.field_work.loader import drive_loader
from tractor_sim.duty_cycle.field_work.measured import draw_job
from tractor_sim.duty_cycle.field_work.mixed import Drive, draw_mixed, joined
from tractor_sim.duty_cycle.field_work.params import (
    FieldWork,
    Loader,
    MeasuredJob,
    Mixed,
    Road,
    operations,
)
from tractor_sim.duty_cycle.field_work.passes import drive_field
from tractor_sim.duty_cycle.field_work.road import draw_route, drive_route
from tractor_sim.duty_cycle.field_work.setup import driveline

OPERATIONS: tuple[str, ...] = (
    "chisel_plow",
    "moldboard_plow",
    "field_cultivator",
    "tandem_disk",
    "row_crop_planter",
    "grain_drill",
    "rotary_hoe",
    "baler",
    "forage_harvest",
    "loader",
    "road_transport",
    "mixed_day",
)
MEASURED_JOBS: tuple[str, ...] = ("measured_job_a", "measured_job_b")
"""Statistical doubles of two measured jobs, scaled to the vehicle's rated power."""

DURATION_MAX_S = 172_800
SEED_MAX = 2**63 - 1


class Work(NamedTuple):
    """One draw, driven.

    Attributes:
        power_w: demand at the bus, shape (T,) [W].
        working: share of each second with the implement at work, shape (T,).
        standing: share of each second at a stop, shape (T,).
        area_m2: worked; None where it is no field work.
    """

    power_w: FloatArray
    working: FloatArray
    standing: FloatArray
    area_m2: float | None


def generate(
    operation: str, seed: int, *, duration_s: int = 1800, depth_cm: float | None = None
) -> DutyCycle:
    """A cycle at steps of 1 s, a pure function of its arguments.

    Args:
        operation: one of ``OPERATIONS`` or ``MEASURED_JOBS``.
        seed: everything else of the draw: width, speed, soil, slope, stops, noise; 0..2^63 - 1.
        duration_s: 1..172800 [s].
        depth_cm: working depth instead of a drawn one, where the implement has one [cm].

    Raises:
        CycleError: an argument is out of range; names the allowed values.
    """
    work = work_of(operation, seed, duration_s=duration_s, depth_cm=depth_cm)
    depth = "" if depth_cm is None else f" at {depth_cm:g} cm"
    return DutyCycle(
        name=f"{operation}_{seed}",
        # Whole watts: bytes that do not hang on the last bit of a processor's exp().
        power_demand_w=np.round(work.power_w) + 0.0,
        dt_s=1.0,
        operation=operation,
        split=None,
        seed=int(seed),
        source=f"generated {operation}{depth}, seed {seed}, config/cycle/operations.yaml",
        area_ha=None if work.area_m2 is None else work.area_m2 / 1e4,
    )


def work_of(
    operation: str, seed: int, *, duration_s: int = 1800, depth_cm: float | None = None
) -> Work:
    """As ``generate``, with what the vehicle was doing in each second.

    Raises:
        CycleError: as ``generate``.
    """
    _check(operation, seed, duration_s, depth_cm)
    rng = np.random.Generator(np.random.PCG64([zlib.crc32(operation.encode()), int(seed)]))
    drive, width_m = _draw(rng, operation, int(duration_s), depth_cm)
    steps = drive_within_limits(drive, operations().vehicle)
    area_m2 = None if width_m is None else width_m * steps.distance_m
    return Work(steps.power_w, steps.working, steps.standing, area_m2)


def _draw(
    rng: np.random.Generator, operation: str, duration_s: int, depth_cm: float | None
) -> tuple[Drive, float | None]:
    """One draw as a drive under a power cap, and its working width [m] if it has one."""
    settings = operations()
    vehicle, work = settings.vehicle, settings.operations[operation]
    if isinstance(work, FieldWork):
        within = settings.within_pass
        field = draw_field(rng, vehicle, work, settings.turn, within, duration_s, depth_cm)
        return (lambda cap_w: drive_field(field, vehicle, within, cap_w)), field.setup.width_m
    if isinstance(work, Road):
        route = draw_route(rng, work, duration_s)
        wheels = driveline(vehicle)
        return (lambda cap_w: drive_route(route, vehicle, wheels, work, cap_w)), None
    if isinstance(work, Loader):
        steps = drive_loader(rng, vehicle, driveline(vehicle), work, duration_s)
        return (lambda cap_w: steps), None
    if isinstance(work, MeasuredJob):
        steps = draw_job(rng, vehicle, work, duration_s)
        return (lambda cap_w: steps), None
    assert isinstance(work, Mixed)
    parts = draw_mixed(rng, work, duration_s, lambda r, name, s: _draw(r, name, s, None)[0])
    return (lambda cap_w: joined(parts, cap_w)), None


def _check(operation: str, seed: int, duration_s: int, depth_cm: float | None) -> None:
    known = OPERATIONS + MEASURED_JOBS
    if operation not in known:
        raise CycleError(f"operation {operation!r}: unknown, one of {', '.join(known)}")
    for name, value, low, high in (
        ("seed", seed, 0, SEED_MAX),
        ("duration_s", duration_s, 1, DURATION_MAX_S),
    ):
        whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
        if not (whole and low <= value <= high):
            raise CycleError(f"{name} {value!r}: allowed are whole numbers from {low} to {high}")
    if depth_cm is None:
        return
    work = operations().operations[operation]
    allowed = work.depth_allowed_cm if isinstance(work, FieldWork) else None
    if allowed is None:
        deep = ", ".join(
            name
            for name, item in operations().operations.items()
            if isinstance(item, FieldWork) and item.depth_allowed_cm is not None
        )
        raise CycleError(
            f"depth_cm {depth_cm!r}: {operation} has no depth; those with one: {deep}"
        )
    if not (allowed[0] <= depth_cm <= allowed[1]):
        raise CycleError(
            f"depth_cm {depth_cm!r}: allowed for {operation} {allowed[0]:g} to {allowed[1]:g} cm"
        )
