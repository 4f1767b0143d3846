"""What a plant's sensors report: plant state to wire samples."""

import numpy as np

from tractor_msgs_py.codec import wire_soc
from tractor_msgs_py.trajectory import FloatArray
from tractor_msgs_py.types import BatteryReading, PowertrainReading
from tractor_sim.battery import current_a, terminal_v
from tractor_sim.powertrain import PlantState, PowertrainParams, StepResult, power_limits


def battery_reading(
    params: PowertrainParams, state: PlantState, last: StepResult | None, stamp_ns: int
) -> BatteryReading:
    """Battery state of the first plant of the batch; voltage and current are those of the last
    step's power at the present SOC."""
    power_w = np.zeros(1) if last is None else last.battery_power_w[:1]
    battery, soc = params.battery, state.soc[:1]
    return BatteryReading(
        stamp_ns,
        float(wire_soc(state.soc[0])),
        float(terminal_v(battery, soc, power_w)[0]),
        float(current_a(battery, soc, power_w)[0]),
    )


def powertrain_reading(
    params: PowertrainParams, state: PlantState, last: StepResult | None, stamp_ns: int
) -> PowertrainReading:
    """Powertrain state of the first plant of the batch; before the first step nothing has been
    applied yet, which reads as zeros."""

    def value(array: FloatArray) -> float:
        return float(array[0])

    limits = power_limits(params, state)
    return PowertrainReading(
        stamp_ns=stamp_ns,
        engine_on=bool(state.engine_on[0]),
        time_in_state_s=value(state.time_in_state_s),
        engine_power_w=value(state.engine_power_w),
        charge_limit_w=value(limits.charge_w),
        discharge_limit_w=value(limits.discharge_w),
        engine_limit_w=value(limits.engine_w),
        applied_battery_power_w=0.0 if last is None else value(last.battery_power_w),
        applied_engine_power_w=0.0 if last is None else value(last.engine_power_w),
        fuel_kg=0.0 if last is None else value(last.fuel_kg),
        shortfall_j=0.0 if last is None else value(last.shortfall_j),
        dissipated_j=0.0 if last is None else value(last.dissipated_j),
    )
