"""Doubles of two measured jobs: passes, turns and idling with the statistics of the recording.

Not physics: powers are fractions of rated power as measured, scaled to the vehicle's.
"""

import numpy as np

from tractor_sim.duty_cycle.field_work.params import MeasuredJob, Vehicle
from tractor_sim.duty_cycle.field_work.timeline import Steps, autoregressive

Stretch = tuple[float, float, float, bool]
"""Start and end of power [s], level, and whether it is a whole pass."""


def draw_job(
    rng: np.random.Generator, vehicle: Vehicle, job: MeasuredJob, duration_s: int
) -> Steps:
    """Demand of one draw at steps of 1 s; ``working`` is the recording's state of that name.

    Power follows a level that is high in stretches of work and moves along ``turn_level`` (at
    the start, middle and end of a turn) between them; it rises and falls at measured ramps.
    """
    time_s = np.arange(duration_s) + 0.5
    level = np.zeros(duration_s)
    working = np.zeros(duration_s)
    idle = np.zeros(duration_s, dtype=bool)
    turn_starts, turn_ends = [0.0], []
    for start, end, height, whole in _stretches(rng, job, duration_s):
        if start > duration_s:
            break
        onset = start + (rng.normal(*job.onset_s) if whole else 0.0)
        release = end + rng.normal(*job.end_lag_s)
        if whole and rng.random() < job.late_chance:
            late_s = rng.uniform(*job.late_s)
            onset, release = onset + late_s, release + late_s
        rise, fall = rng.uniform(*job.rise_per_s), rng.uniform(*job.fall_per_s)
        near = slice(max(0, int(start) - 15), min(duration_s, int(end) + 15))
        shape = np.minimum((time_s[near] - onset) * rise, (release - time_s[near]) * fall + height)
        level[near] = np.maximum(level[near], np.clip(shape, 0.0, height))
        working[near] = np.maximum(working[near], (time_s[near] >= start) & (time_s[near] < end))
        turn_ends.append(start)
        turn_starts.append(end)
    turn_ends.append(float(duration_s) + 30.0)
    turning = np.zeros(duration_s)
    for start, end in zip(turn_starts, turn_ends, strict=True):
        inside = (time_s >= start - 10) & (time_s < end + 10)
        along = np.clip((time_s[inside] - start) / min(max(end - start, 1.0), 60.0), 0.0, 1.0)
        turning[inside] = np.interp(along, (0.0, 0.35, 1.0), job.turn_level)
        if end - start > job.piece_gap_s[1]:
            idle |= (time_s >= start + 25.0) & (time_s < end - 32.0)
    noise = job.noise_sd * autoregressive(rng, duration_s, job.noise_lag1)
    turn_noise = job.turn_noise_sd * autoregressive(rng, duration_s, job.turn_noise_lag1)
    high = level > turning
    quiet = ~high | (level < 0.3)
    fraction = np.maximum(level, turning) + np.where(quiet, turn_noise, noise)
    fraction = np.where(idle & ~high, job.idle_level * (1.0 + 2.0 * noise), fraction)
    power = np.clip(fraction, 0.01, 1.0) * vehicle.rated_power_w
    return Steps(power, working, idle.astype(float), 0.0)


def _stretches(rng: np.random.Generator, job: MeasuredJob, duration_s: int) -> list[Stretch]:
    """Stretches of work in order, until the duration is covered."""

    def normal(pair: tuple[float, float]) -> float:
        return float(np.clip(rng.normal(*pair), pair[0] - 2 * pair[1], pair[0] + 3 * pair[1]))

    stretches: list[Stretch] = []
    clock = float(rng.uniform(20.0, 40.0))
    regular = rng.random() < 0.5
    while clock <= duration_s:
        if regular:
            for _ in range(int(rng.integers(*job.passes_per_block, endpoint=True))):
                length = normal(job.pass_s)
                stretches.append((clock, clock + length, normal(job.level), True))
                clock += length + normal(job.turn_s)
        else:
            for _ in range(int(rng.integers(*job.pieces_per_block, endpoint=True))):
                if rng.random() < job.idle_chance:
                    clock += float(rng.uniform(*job.idle_s))
                length = float(rng.uniform(*job.piece_s))
                level = float(rng.uniform(*job.piece_level))
                stretches.append((clock, clock + length, level, False))
                clock += length + float(rng.uniform(*job.piece_gap_s))
            clock += 15.0
        regular = not regular
    return stretches
