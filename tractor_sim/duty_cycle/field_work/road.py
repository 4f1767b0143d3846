"""Road transport: hills, speed limits and stops; braking and downhill give power back."""

from dataclasses import dataclass

import numpy as np

from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.duty_cycle.field_work.params import Road, Vehicle
from tractor_sim.duty_cycle.field_work.powers import GRAVITY_M_PER_S2, Driveline
from tractor_sim.duty_cycle.field_work.terrain import grades
from tractor_sim.duty_cycle.field_work.timeline import (
    Steps,
    autoregressive,
    speed_profile,
    to_steps,
)

_CELL_M = 5.0
_AIR_KG_PER_M3 = 1.2
_CREEP_M_PER_S = 0.7
_CAP_ROUNDS = 12
_FOOT = np.array([0.25, 0.5, 0.25])
"""A foot takes seconds from brake to power: weights of three seconds of demand (assumed)."""


@dataclass(frozen=True)
class Route:
    """A road drawn and not yet driven: per cell of 5 m, and noise per second."""

    duration_s: int
    mass_kg: float
    limit_m_per_s: FloatArray
    grade: FloatArray
    dwell_s: FloatArray
    noise: FloatArray


def draw_route(rng: np.random.Generator, work: Road, duration_s: int) -> Route:
    """Sections with their own speed, some ending in a stop, over hills."""
    mass_kg = float(rng.uniform(*work.weight_kg))
    length_m = 1.1 * duration_s * work.speed_km_h[1] / 3.6 + 200.0
    cells = int(length_m / _CELL_M)
    limit = np.empty(cells)
    dwell = np.zeros(cells)
    dwell[0] = rng.uniform(5.0, 20.0)
    at = 0
    while at < cells:
        end = at + max(4, int(rng.uniform(*work.section_m) / _CELL_M))
        limit[at:end] = rng.uniform(*work.speed_km_h) / 3.6
        if end < cells and rng.random() < work.stop_chance:
            dwell[end - 1] = rng.uniform(*work.stop_s)
        at = end
    limit = np.where(dwell > 0, _CREEP_M_PER_S, limit)
    place_m = np.arange(0.0, cells) * _CELL_M
    grade = grades(rng, place_m, work.grade_max * rng.uniform(0.5, 1.0), work.wave_m)
    noise = work.noise_sd * autoregressive(rng, duration_s, work.noise_lag1)
    return Route(duration_s, mass_kg, limit, grade - grade.mean(), dwell, noise)


def drive_route(
    route: Route, vehicle: Vehicle, drive: Driveline, work: Road, cap_w: float
) -> Steps:
    """Demand at steps of 1 s; where steady speed needs more than the cap, slower."""
    mass = route.mass_kg

    def demand_w(speed: FloatArray, grade: FloatArray, accel: FloatArray) -> FloatArray:
        force = (
            mass * GRAVITY_M_PER_S2 * (work.rolling + grade)
            + 0.5 * _AIR_KG_PER_M3 * work.drag_area_m2 * speed**2
            + mass * accel
        )
        return drive.axle_to_bus_w(force * speed)

    low = np.full_like(route.limit_m_per_s, _CREEP_M_PER_S)
    high = route.limit_m_per_s
    still = np.zeros_like(low)
    fits = demand_w(high, route.grade, still) <= cap_w
    for _ in range(_CAP_ROUNDS):
        middle = (low + high) / 2.0
        too_fast = demand_w(middle, route.grade, still) > cap_w
        low, high = np.where(too_fast, low, middle), np.where(too_fast, middle, high)
    limit = np.where(fits, route.limit_m_per_s, low)
    speed, accel = speed_profile(
        limit, _CELL_M, _CREEP_M_PER_S, work.speed_up_m_per_s2, work.slow_down_m_per_s2
    )
    speed = np.maximum(speed, _CREEP_M_PER_S)
    moving = demand_w(speed, route.grade, accel) + work.idle_w
    # What speeding up needs beyond the cap takes longer instead: the same energy at the cap.
    longer = np.maximum(1.0, moving / cap_w)
    moving = moving / longer
    move_s = _CELL_M / speed * longer
    cell_s = move_s + route.dwell_s
    power = (moving * move_s + work.idle_w * route.dwell_s) / cell_s
    standing = route.dwell_s / cell_s
    steps = to_steps(route.duration_s, cell_s, power, np.zeros_like(power), 1 - standing, standing)
    power = np.convolve(np.pad(steps.power_w, 1, mode="edge"), _FOOT, mode="valid")
    noisy = power + route.noise * np.abs(power) * steps.working
    return Steps(noisy, steps.working, steps.standing, 0.0)
