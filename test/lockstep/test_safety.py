"""Whatever a policy asks, what is published lies within the published limits."""

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from tractor_ems.safety import fallback_command, safe_command
from tractor_msgs_py.observation import Observation
from tractor_msgs_py.types import CommandMode
from tractor_sim.powertrain import Command

WATT = st.floats(0.0, 3e5)


def observation(demand_w, charge_w, discharge_w, engine_w) -> Observation:
    one = np.ones(1)
    return Observation(
        stamp_ns=1,
        power_demand_w=demand_w * one,
        soc=0.8 * one,
        soc_target=0.8 * one,
        engine_on=np.zeros(1, bool),
        time_in_state_s=one,
        engine_power_w=0.0 * one,
        charge_limit_w=charge_w * one,
        discharge_limit_w=discharge_w * one,
        engine_limit_w=engine_w * one,
        features=np.zeros((1, 0)),
    )


def limits(seen) -> tuple[float, float]:
    demand_w = seen.power_demand_w[0]
    lb = max(-seen.charge_limit_w[0], demand_w - seen.engine_limit_w[0])
    return lb, max(lb, min(seen.discharge_limit_w[0], demand_w))


@given(
    demand_w=st.floats(-1e5, 5e5), charge_w=WATT, discharge_w=WATT, engine_w=WATT,
    battery_w=st.floats(), asked_engine_w=st.floats(),
)  # fmt: skip
def test_every_command_becomes_finite_feasible_and_nominal(
    demand_w, charge_w, discharge_w, engine_w, battery_w, asked_engine_w
):
    seen = observation(demand_w, charge_w, discharge_w, engine_w)
    asked = Command(np.array([battery_w]), np.array([asked_engine_w]))
    command, corrected = safe_command(seen, asked)
    lb, ub = limits(seen)
    assert lb <= command.battery_power_w <= ub
    assert command.mode is CommandMode.NOMINAL and not math.isinf(command.engine_power_w)
    again, corrected_again = safe_command(
        seen, Command(np.array([command.battery_power_w]), np.array([command.engine_power_w]))
    )
    assert again.battery_power_w == command.battery_power_w and not corrected_again
    assert corrected or abs(command.battery_power_w - battery_w) <= 1e-3


@given(demand_w=st.floats(-1e5, 5e5), charge_w=WATT, discharge_w=WATT, engine_w=WATT)
def test_fallback_is_zero_battery_power_projected(demand_w, charge_w, discharge_w, engine_w):
    seen = observation(demand_w, charge_w, discharge_w, engine_w)
    lb, ub = limits(seen)
    command = fallback_command(seen, CommandMode.FALLBACK)
    assert command.battery_power_w == min(max(0.0, lb), ub)
    assert (command.stamp_ns, command.mode) == (1, CommandMode.FALLBACK)
