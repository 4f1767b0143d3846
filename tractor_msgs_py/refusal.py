"""Which samples must not be used: one rule for the live node and the bag reader."""

import math

from tractor_msgs_py.signals import MAX_POWER_W
from tractor_msgs_py.types import (
    BatteryPowerCommand,
    BatteryReading,
    PowerDemand,
    PowertrainReading,
    RunInfo,
)


def refusal(
    sample: PowerDemand | BatteryReading | PowertrainReading | BatteryPowerCommand,
    run: RunInfo | None,
) -> str | None:
    """Why a sample must not be used, or None: one rule for the live node and the bag reader.

    ``zero_stamp``; with a run ``stamp_outside_run`` and, in lockstep, ``stamp_off_grid``;
    ``soc_out_of_range``, ``not_finite``, ``demand_out_of_range``. The values of a command are
    not judged: the plant projects whatever a policy answered.
    """
    if sample.stamp_ns <= 0:
        return "zero_stamp"
    if run is not None:
        if not run.t0_ns <= sample.stamp_ns <= run.stamp_ns(run.steps):
            return "stamp_outside_run"
        if run.lockstep and (sample.stamp_ns - run.t0_ns) % run.dt_ns:
            return "stamp_off_grid"
    match sample:
        case PowerDemand():
            values: tuple[float, ...] = (sample.power_w,)
        case BatteryReading():
            return None if 0.0 <= sample.soc <= 1.0 else "soc_out_of_range"
        case BatteryPowerCommand():
            return None
        case PowertrainReading():
            values = (
                sample.time_in_state_s,
                sample.engine_power_w,
                sample.charge_limit_w,
                sample.discharge_limit_w,
                sample.engine_limit_w,
                sample.applied_battery_power_w,
                sample.applied_engine_power_w,
                sample.fuel_kg,
                sample.shortfall_j,
                sample.dissipated_j,
            )
    if not all(math.isfinite(value) for value in values):
        return "not_finite"
    if isinstance(sample, PowerDemand) and abs(sample.power_w) > MAX_POWER_W:
        return "demand_out_of_range"
    return None
