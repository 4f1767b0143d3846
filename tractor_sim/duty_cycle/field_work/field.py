"""The field of one draw: soil, crop, slope, turns and stops, before anything is driven.

Drawing and driving are apart, so that a lower power cap drives the same field slower.
"""

from dataclasses import dataclass

import numpy as np

from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.duty_cycle.field_work.params import FieldWork, Stop, Turn, Vehicle, WithinPass
from tractor_sim.duty_cycle.field_work.setup import Setup, draw_setup
from tractor_sim.duty_cycle.field_work.terrain import flip_alternate, grades, patches
from tractor_sim.duty_cycle.field_work.timeline import autoregressive

CELL_M = 2.0
"""Length of a piece of a pass."""

CREEP_M_PER_S = 0.3
"""Nothing is driven slower: a stop is a creep and a stand."""

TURN_PIECES = 40


@dataclass(frozen=True)
class Field:
    """The field of one draw, in driving order.

    Attributes:
        duration_s: of the cycle.
        setup: see ``Setup``.
        soil, crop, grade: per (pass, cell).
        speed_limit_m_per_s: aimed at, per (pass, cell).
        dwell_s: stands within a pass, per (pass, cell).
        turn_s, turn_speed_m_per_s, turn_w: per pass [s, m/s], power per (pass, turn piece) [W].
        stop_s, stop_w: stand after each pass, shape (passes, 2): refill and wait.
        start_s: stand before the first pass.
        noise, turn_noise: AR(1) of sd 1 per step.
        plunger: per step, share of crop power; 0 without a plunger.
    """

    duration_s: int
    setup: Setup
    soil: FloatArray
    crop: FloatArray
    grade: FloatArray
    speed_limit_m_per_s: FloatArray
    dwell_s: FloatArray
    turn_s: FloatArray
    turn_speed_m_per_s: float
    turn_w: FloatArray
    stop_s: FloatArray
    stop_w: FloatArray
    start_s: float
    noise: FloatArray
    turn_noise: FloatArray
    plunger: FloatArray


def draw_field(
    rng: np.random.Generator,
    vehicle: Vehicle,
    work: FieldWork,
    turn: Turn,
    within: WithinPass,
    duration_s: int,
    depth_cm: float | None,
) -> Field:
    """Everything of a cycle that does not depend on how fast it is driven."""
    setup = draw_setup(rng, vehicle, work, depth_cm)
    length_m = float(rng.uniform(*work.field_length_m))
    turn_mean_s = float(rng.uniform(*turn.duration_s))
    start_s = float(rng.uniform(5.0, 20.0))
    cells = max(8, round(length_m / CELL_M))
    fastest_s = cells * CELL_M / (1.3 * setup.speed_m_per_s) + 0.5 * turn_mean_s
    passes = int(duration_s / fastest_s) + 2

    place_m = (np.arange(0.0, cells) + 0.5) * CELL_M
    slope = grades(rng, place_m, work.grade_max * rng.uniform(0.2, 1.0), (150.0, 600.0))
    grade = flip_alternate(np.tile(slope, (passes, 1)), sign=-1.0)
    ground = {"cell_m": CELL_M, "spacing_m": setup.width_m}
    soil = patches(rng, passes, cells, length_m=work.soil_patch_m, **ground)
    level = 1.0 + within.level_sd * rng.standard_normal((passes, 1))
    engaged = np.minimum(place_m / work.engage_m, (place_m[-1] + CELL_M - place_m) / CELL_M)
    engaged = np.clip(engaged, 0.0, 1.0)
    soil = np.clip(1.0 + work.soil_sd * soil, 0.4, 1.8) * np.clip(level, 0.7, 1.3)
    crop = np.zeros_like(soil)
    if work.pto is not None:
        drawn = patches(rng, passes, cells, length_m=work.pto.crop_patch_m, **ground)
        crop = flip_alternate(np.clip(1.0 + work.pto.crop_sd * drawn, 0.2, 1.9)) * engaged
    soil = flip_alternate(soil) * engaged

    pass_speed = 1.0 + within.speed_sd * rng.standard_normal((passes, 1))
    limit = setup.speed_m_per_s * np.clip(pass_speed, 0.8, 1.2) * np.ones((1, cells))
    dwell_s = _dwell(rng, work.mid_pass_stop, passes, cells)
    limit = np.where(dwell_s > 0, CREEP_M_PER_S, limit)

    turn_s = turn_mean_s + turn.duration_sd_s * rng.standard_normal(passes)
    turn_s = np.clip(turn_s, 0.7 * turn_mean_s, 1.6 * turn_mean_s)
    turn_speed = float(rng.uniform(*turn.speed_km_h)) / 3.6
    stops = [_stops(rng, stop, passes, cells * CELL_M) for stop in (work.refill, work.wait)]
    stop_w = [0.0 if stop is None else stop.power_w for stop in (work.refill, work.wait)]
    return Field(
        duration_s,
        setup,
        soil,
        crop,
        grade,
        limit,
        dwell_s,
        turn_s,
        turn_speed,
        _turn_power(setup, turn, turn_speed),
        np.stack(stops, axis=1),
        np.array(stop_w),
        start_s,
        within.noise_sd * autoregressive(rng, duration_s, within.noise_lag1),
        turn.noise_sd * autoregressive(rng, duration_s, turn.noise_lag1),
        _plunger(rng, work, duration_s),
    )


def _turn_power(setup: Setup, turn: Turn, speed_m_per_s: float) -> FloatArray:
    """Bus power over a turn, shape (TURN_PIECES,): roll, steer, lift at first, lower at last."""
    share = (np.arange(TURN_PIECES) + 0.5) / TURN_PIECES
    zero = np.zeros(TURN_PIECES)
    # The oil for a working fan or marker runs on through the turn, as does an unloaded PTO.
    rolling = setup.demand_w(np.full(TURN_PIECES, speed_m_per_s), zero, zero, zero, zero)
    oil = turn.steering_w + turn.hydraulic_w * ((share < 0.15) + 0.5 * (share > 0.9))
    power: FloatArray = rolling + oil / setup.drive.hydraulic_efficiency
    return power


def _stops(rng: np.random.Generator, stop: Stop | None, passes: int, pass_m: float) -> FloatArray:
    """Seconds of standing after each pass, shape (passes,)."""
    if stop is None:
        return np.zeros(passes)
    stands = rng.random(passes) < stop.chance
    if stop.every_m[1] > 0:
        every_m = rng.uniform(*stop.every_m)
        worked = rng.uniform(0.2, 1.0) * every_m + pass_m * np.arange(passes + 1)
        stands |= np.diff(np.floor(worked / every_m)) > 0
    seconds: FloatArray = np.where(stands, rng.uniform(*stop.duration_s, passes), 0.0)
    return seconds


def _dwell(rng: np.random.Generator, stop: Stop | None, passes: int, cells: int) -> FloatArray:
    """Seconds of standing at each cell, shape (passes, cells)."""
    dwell = np.zeros((passes, cells))
    if stop is None:
        return dwell
    every_m = rng.uniform(*stop.every_m)
    gaps = rng.uniform(0.85, 1.15, int(passes * cells * CELL_M / every_m) + 2)
    at = (np.cumsum(gaps) * every_m / CELL_M).astype(int)
    at = at[at < passes * cells]
    dwell.ravel()[at] = rng.uniform(*stop.duration_s, len(at))
    return dwell


def _plunger(rng: np.random.Generator, work: FieldWork, duration_s: int) -> FloatArray:
    """Stroke ripple averaged over each second, share of crop power, shape (duration,).

    A stroke is faster than the step, so the step sees the mean of the sine over 1 s: the swing
    shrinks by sin(pi f) / (pi f) and shows at the alias of f. Stroke rate wanders with PTO speed.
    """
    if work.plunger is None:
        return np.zeros(duration_s)
    wander = 1.0 + 0.01 * autoregressive(rng, duration_s, 0.95)
    strokes = np.concatenate([[0.0], np.cumsum(rng.uniform(*work.plunger.frequency_hz) * wander)])
    phase = 2.0 * np.pi * (strokes + rng.random())
    ripple: FloatArray = -work.plunger.swing * np.diff(np.cos(phase)) / np.diff(phase)
    return ripple
