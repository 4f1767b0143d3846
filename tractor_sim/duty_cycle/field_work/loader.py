"""Short loading cycles: approach, dig, reverse and lift, haul, dump, back; waits for a truck."""

import numpy as np

from tractor_sim.duty_cycle.field_work.params import Loader, Vehicle
from tractor_sim.duty_cycle.field_work.powers import GRAVITY_M_PER_S2, Driveline
from tractor_sim.duty_cycle.field_work.timeline import Steps, autoregressive, to_steps

_LEG_PIECES = 12
"""Pieces per driven leg: speed up, hold, slow down."""


def drive_loader(
    rng: np.random.Generator, vehicle: Vehicle, drive: Driveline, work: Loader, duration_s: int
) -> Steps:
    """Demand of one draw at steps of 1 s.

    Legs are trapezoids in speed, so kinetic energy is taken up and given back; lifting is
    potential energy of bucket, boom and load over the leg in which the boom rises.
    """
    place = {
        "approach": float(rng.uniform(*work.approach_m)),
        "haul": float(rng.uniform(*work.haul_m)),
        "height": float(rng.uniform(*work.lift_height_m)),
    }
    mean_payload = float(rng.uniform(*work.payload_kg))
    pieces: list[tuple[float, float, float]] = [(float(rng.uniform(5.0, 15.0)), work.idle_w, 1.0)]
    total_s = pieces[0][0]
    left = int(rng.integers(work.trucks_every_cycles[0], work.trucks_every_cycles[1] + 1))
    while total_s < duration_s:
        payload = mean_payload * float(rng.uniform(0.75, 1.15))
        new = _cycle(rng, drive, work, place, payload)
        left -= 1
        if left == 0:
            new.append((float(rng.uniform(*work.wait_s)), work.idle_w, 1.0))
            left = int(rng.integers(work.trucks_every_cycles[0], work.trucks_every_cycles[1] + 1))
        pieces += new
        total_s += sum(piece[0] for piece in new)
    table = np.array(pieces)
    still = table[:, 2]
    steps = to_steps(duration_s, table[:, 0], table[:, 1], 0.0 * still, 1.0 - still, still)
    noise = work.noise_sd * autoregressive(rng, duration_s, work.noise_lag1)
    power = steps.power_w * (1.0 + noise * steps.working)
    return Steps(power, steps.working, steps.standing, 0.0)


def _cycle(
    rng: np.random.Generator,
    drive: Driveline,
    work: Loader,
    place: dict[str, float],
    payload_kg: float,
) -> list[tuple[float, float, float]]:
    """One bucket as (seconds, bus W, standing 0 or 1)."""

    def speed() -> float:
        return float(rng.uniform(*work.speed_km_h)) / 3.6

    tilt_w = work.tilt_hydraulic_w / work.oil_efficiency
    rise_j = (payload_kg + work.boom_kg) * GRAVITY_M_PER_S2 * place["height"] / work.oil_efficiency
    loaded = work.weight_kg + payload_kg
    dig_s = float(rng.uniform(*work.dig_s))
    dig_axle_w = float(rng.uniform(*work.dig_force_n)) * work.dig_speed_km_h / 3.6
    # The bucket is crowded and curled in bursts while the wheels push, gently at first; what
    # exceeds the machine's power takes longer.
    bursts = rng.dirichlet(np.full(4, 8.0)) * np.array([2.4, 4.0, 4.0, 4.0])
    dig = []
    for burst in bursts.tolist():
        need_w = _bus_w(drive, dig_axle_w * (0.6 + 0.4 * burst), tilt_w * burst)
        longer = max(1.0, need_w / work.power_max_w)
        dig.append((dig_s / 4 * longer, need_w / longer, 0.0))
    return [
        *_leg(drive, work, work.weight_kg, place["approach"], speed(), 0.0),
        *dig,
        *_leg(drive, work, loaded, place["approach"], speed(), 0.35 * rise_j),
        *_leg(drive, work, loaded, place["haul"], 0.8 * speed(), 0.65 * rise_j),
        (float(rng.uniform(*work.dump_s)), _bus_w(drive, 0.0, 0.6 * tilt_w), 0.0),
        *_leg(drive, work, work.weight_kg, place["haul"], speed(), 0.0),
    ]


def _bus_w(drive: Driveline, axle_w: float, oil_w: float) -> float:
    return float(drive.axle_to_bus_w(np.array(axle_w))) + oil_w / drive.hydraulic_efficiency


def _leg(
    drive: Driveline, work: Loader, mass_kg: float, distance_m: float, speed: float, rise_j: float
) -> list[tuple[float, float, float]]:
    """A drive from rest to rest; ``rise_j`` of lifting is spread evenly over it."""
    accel = work.speed_up_m_per_s2
    top = min(speed, float(np.sqrt(accel * distance_m)))
    ramp_s, hold_s = top / accel, max(0.0, distance_m / top - top / accel)
    k = _LEG_PIECES // 3
    middles = (np.arange(k) + 0.5) / k
    speeds = np.concatenate([top * middles, np.full(k, top), top * middles[::-1]])
    force = np.repeat([accel, 0.0, -accel], k) * mass_kg
    seconds = np.repeat([ramp_s, hold_s, ramp_s], k) / k
    axle = (force + mass_kg * GRAVITY_M_PER_S2 * work.rolling) * speeds
    oil = rise_j / seconds.sum() + 0.05 * work.tilt_hydraulic_w
    power = drive.axle_to_bus_w(axle) + oil / drive.hydraulic_efficiency
    return [(s, p, 0.0) for s, p in zip(seconds.tolist(), power.tolist(), strict=True)]
