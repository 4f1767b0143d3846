"""Drive a drawn field: speed under a power cap, time, energy, noise, seconds of demand."""

import numpy as np
from numpy.typing import NDArray

from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.duty_cycle.field_work.field import CELL_M, CREEP_M_PER_S, TURN_PIECES, Field
from tractor_sim.duty_cycle.field_work.params import Vehicle, WithinPass
from tractor_sim.duty_cycle.field_work.timeline import Steps, speed_profile, to_steps

_CAP_ROUNDS = 12


def drive_field(field: Field, vehicle: Vehicle, within: WithinPass, cap_w: float) -> Steps:
    """Demand of one field under a power cap, at steps of 1 s.

    Where the aimed speed needs more than the cap, the speed is the one that needs the cap.
    """
    setup = field.setup
    limit = _capped_speed(field, cap_w)
    speed, acceleration = speed_profile(
        limit,
        CELL_M,
        field.turn_speed_m_per_s,
        within.speed_up_m_per_s2,
        within.slow_down_m_per_s2,
    )
    speed = np.maximum(speed, CREEP_M_PER_S)
    demand = setup.demand_w(speed, field.soil, field.crop, field.grade, acceleration)
    # What speeding up needs beyond the cap takes longer instead: the same energy at the cap.
    longer = np.maximum(1.0, demand / cap_w)
    demand = demand / longer
    move_s = CELL_M / speed * longer
    zero = np.zeros(1)
    crop_w = np.zeros_like(demand)
    standing_w = vehicle.idle_w + setup.work.hydraulic_w / setup.drive.hydraulic_efficiency
    if setup.work.pto is not None:
        pto = setup.work.pto
        throughput = field.crop * setup.crop_kg_per_m2 * setup.width_m * speed
        crop_w = pto.energy_j_per_kg * throughput / setup.drive.pto_efficiency / longer
        standing_w += pto.idle_w / setup.drive.pto_efficiency
    pass_s = move_s + field.dwell_s
    pass_w = (demand * move_s + standing_w * field.dwell_s) / pass_s

    turn_s = np.repeat(field.turn_s[:, None] / TURN_PIECES, TURN_PIECES, axis=1)
    turn_w = np.broadcast_to(field.turn_w, turn_s.shape)
    stop_w = np.broadcast_to(field.stop_w, field.stop_s.shape)
    engaged = ((field.soil > 0.3) | (field.crop > 0.1)).astype(float)
    none_turn, none_stop = np.zeros_like(turn_s), np.zeros_like(field.stop_s)

    def pieces(start: float, *blocks: FloatArray) -> FloatArray:
        return np.concatenate([zero + start, np.concatenate(blocks, axis=1).ravel()])

    def steps(power: FloatArray, turning: FloatArray, standing: FloatArray, start: float) -> Steps:
        return to_steps(
            field.duration_s,
            pieces(field.start_s, pass_s, turn_s, field.stop_s),
            pieces(start, power, turning, standing),
            pieces(0.0, np.full_like(pass_s, CELL_M), none_turn, none_stop),
            pieces(0.0, engaged * move_s / pass_s, none_turn, none_stop),
            pieces(1.0, field.dwell_s / pass_s, none_turn, np.ones_like(none_stop)),
        )

    drive = steps(pass_w, turn_w, stop_w, vehicle.idle_w)
    power = drive.power_w
    moving = 1.0 - drive.standing
    noise = field.noise * drive.working + field.turn_noise * (moving - drive.working)
    power = power * np.maximum(1.0 + noise, 0.2)
    if setup.work.plunger is not None:
        crop = steps(crop_w * move_s / pass_s, none_turn, none_stop, 0.0).power_w
        power = power + field.plunger * crop
    return Steps(power, drive.working, drive.standing, drive.distance_m)


def _capped_speed(field: Field, cap_w: float) -> FloatArray:
    """Aimed speed, or the one at which steady demand is the cap, by bisection (passes, cells)."""
    limit = field.speed_limit_m_per_s
    setup = field.setup

    def over(speed: FloatArray, at: NDArray[np.bool_]) -> NDArray[np.bool_]:
        soil, crop, grade = field.soil[at], field.crop[at], field.grade[at]
        return setup.demand_w(speed, soil, crop, grade, np.zeros_like(speed)) > cap_w

    everywhere = np.ones(limit.shape, dtype=np.bool_)
    at = over(limit.ravel(), everywhere).reshape(limit.shape)
    high = limit[at]
    low = np.full_like(high, CREEP_M_PER_S)
    for _ in range(_CAP_ROUNDS):
        middle = (low + high) / 2.0
        too_fast = over(middle, at)
        high = np.where(too_fast, middle, high)
        low = np.where(too_fast, low, middle)
    capped = limit.copy()
    capped[at] = low
    return capped
