"""What a vehicle can hold: the power cap a driver works to so that demand stays drivable."""

from collections.abc import Callable

import numpy as np

from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.duty_cycle.field_work.params import Vehicle
from tractor_sim.duty_cycle.field_work.timeline import Steps

_ROUNDS = 20
_CAP_MIN_W = 20e3


def highest_window_mean_w(power_w: FloatArray, window_s: int) -> float:
    """Largest mean over any window; over everything where that is shorter [W]."""
    window = min(window_s, len(power_w))
    total = np.concatenate([[0.0], np.cumsum(power_w)])
    return float((total[window:] - total[:-window]).max()) / window


def drive_within_limits(drive: Callable[[float], Steps], vehicle: Vehicle) -> Steps:
    """Drive under the highest cap, of a falling row, whose demand the vehicle can hold.

    Args:
        drive: demand of the same draw under a power cap [W].
        vehicle: its ``cap_w`` is tried first; mean over ``mean_window_s`` must stay below
            ``mean_max_w``. Noise above ``sample_max_w`` or
            below what braking gives back is cut there.
    """
    cap_w = vehicle.cap_w
    for _ in range(_ROUNDS):
        steps = drive(cap_w)
        power = np.clip(steps.power_w, -vehicle.regeneration_max_w, vehicle.sample_max_w)
        highest = highest_window_mean_w(power, vehicle.mean_window_s)
        if highest <= vehicle.mean_max_w:
            return Steps(power, steps.working, steps.standing, steps.distance_m)
        # Aim a little below: only part of the time is at the cap.
        cap_w = max(_CAP_MIN_W, 0.985 * cap_w * vehicle.mean_max_w / highest)
    raise ValueError(f"demand stays above {vehicle.mean_max_w} W under a cap of {cap_w} W")
