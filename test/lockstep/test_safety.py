"""Whatever a policy asks, what is published lies within the published limits."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tractor_ems.policies.protocol import limits_of
from tractor_ems.safety import (
    fallback_command,
    generator_set_point_w,
    safe_command,
    vehicle_command,
    vehicle_fallback,
    within_powertrain,
)
from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.observation import Observation
from tractor_msgs_py.types import CommandMode, Reason
from tractor_sim.config import load_powertrain
from tractor_sim.powertrain import Command
from tractor_sim.safe_command import RampLimit, bounds_w, ramp_limit

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


FIELD = load_powertrain("field")
LIMITS = ("charge_limit_w", "discharge_limit_w", "engine_limit_w")
few = settings(max_examples=60, deadline=None)


def asked(battery_w, engine_w=math.nan) -> Command:
    return Command(np.array([battery_w]), np.array([engine_w]))


def bounds(seen) -> tuple[float, float]:
    lb, ub = bounds_w(limits_of(seen), seen.power_demand_w)
    return float(lb[0]), float(ub[0])


@few
@given(
    demand_w=st.floats(), charge_w=st.floats(), discharge_w=st.floats(), engine_w=st.floats(),
    battery_w=st.floats(), asked_engine_w=st.floats() | st.just(0.0),
    before_w=st.floats(), change_w=st.floats(0.0, math.inf),
)  # fmt: skip
def test_whatever_is_seen_and_asked_a_vehicle_gets_finite_feasible_power(
    demand_w, charge_w, discharge_w, engine_w, battery_w, asked_engine_w, before_w, change_w
):
    seen = observation(demand_w, charge_w, discharge_w, engine_w)
    lb, ub = bounds(seen)
    assert math.isfinite(lb) and math.isfinite(ub) and lb <= ub
    for ramp in (None, RampLimit(before_w, change_w)):
        command, _ = vehicle_command(seen, asked(battery_w, asked_engine_w), ramp)
        fallen = vehicle_fallback(seen, Reason.OBSERVATION_STALE, ramp=ramp)
        for sent in (command, fallen):
            assert lb <= sent.battery_power_w <= ub
            assert not math.isinf(sent.engine_power_w)


@given(
    demand_w=st.floats(-1e5, 3e5), charge_w=WATT, discharge_w=WATT, engine_w=WATT,
    battery_w=st.floats(),
)  # fmt: skip
@few
def test_where_there_is_a_choice_a_vehicle_gets_the_simulators_power(
    demand_w, charge_w, discharge_w, engine_w, battery_w
):
    seen = observation(demand_w, charge_w, discharge_w, engine_w)
    if limits(seen)[0] <= min(discharge_w, demand_w):
        wish = asked(battery_w)
        (one, moved), (other, moved_too) = vehicle_command(seen, wish), safe_command(seen, wish)
        assert (one.battery_power_w, moved) == (other.battery_power_w, moved_too)


def test_beyond_engine_and_battery_a_vehicle_gets_the_batterys_limit():
    assert vehicle_command(observation(9e5, 1e5, 1e5, 2e5), asked(0.0))[0].battery_power_w == 1e5
    assert vehicle_command(observation(-9e5, 1e5, 1e5, 2e5), asked(0.0))[0].battery_power_w == -1e5


@few
@given(
    before_w=st.floats(0.0, 2e5), change_w=st.floats(0.0, 1e5),
    demand_w=st.floats(-1e5, 3e5), battery_w=st.floats(-3e5, 3e5), off=st.booleans(),
)  # fmt: skip
def test_the_generator_keeps_its_ramp_as_far_as_feasible(
    before_w, change_w, demand_w, battery_w, off
):
    seen = observation(demand_w, 1e5, 1e5, 2e5)
    wish = asked(battery_w, 0.0 if off else math.nan)
    command, _ = vehicle_command(seen, wish, RampLimit(before_w, change_w))
    after_w = generator_set_point_w(seen, command)
    lb, ub = bounds(seen)
    least_w, most_w = max(demand_w - ub, 0.0), max(demand_w - lb, 0.0)
    nearest_w = min(max(before_w, least_w), most_w)  # what feasibility forces, ramp or not
    assert abs(after_w - before_w) <= max(change_w, abs(nearest_w - before_w)) + 1e-6


def test_engine_off_waits_for_the_ramp_and_then_is_said():
    seen, before_w, said = observation(50e3, 1e5, 1e5, 2e5), 50e3, []
    for _ in range(4):
        command, _ = vehicle_command(seen, asked(50e3, 0.0), RampLimit(before_w, 20e3))
        before_w = generator_set_point_w(seen, command)
        said.append((before_w, command.engine_power_w))
    assert [w for w, _ in said] == [30e3, 10e3, 0.0, 0.0]
    assert math.isnan(said[1][1]) and [engine_w for _, engine_w in said[2:]] == [0.0, 0.0]


def test_feasibility_wins_over_the_ramp():
    braking = observation(-80e3, 60e3, 1e5, 2e5)
    command, _ = vehicle_command(braking, asked(0.0), RampLimit(150e3, 10e3))
    assert command.battery_power_w == -60e3


def test_the_fallback_law_is_reached_along_the_ramp_with_its_reason():
    seen, before_w = observation(100e3, 1e5, 1e5, 2e5), 40e3
    sent = []
    for _ in range(4):
        command = vehicle_fallback(seen, Reason.FAULT, ramp=RampLimit(before_w, 25e3))
        before_w = generator_set_point_w(seen, command)
        sent.append(command.battery_power_w)
    assert sent == [35e3, 10e3, 0.0, 0.0]
    assert (command.mode, command.reason) == (CommandMode.FALLBACK, Reason.FAULT)


def test_an_unknown_demand_gets_the_fallback_law_whatever_is_asked():
    seen = observation(math.nan, 1e5, 1e5, 2e5)
    command, corrected = vehicle_command(seen, asked(-50e3, 0.0))
    assert command.battery_power_w == 0.0 and math.isnan(command.engine_power_w) and corrected


@pytest.mark.parametrize("ramp", [None, 0.0, math.inf])
def test_no_ramp_is_no_limit(ramp):
    assert ramp_limit(1.0, ramp, 0.1) is None


@pytest.mark.parametrize("ramp", [-1.0, math.nan])
def test_a_ramp_out_of_range_is_refused(ramp):
    with pytest.raises(ConfigError, match=r"^ramp_w_per_s: "):
        ramp_limit(1.0, ramp, 0.1)


@few
@given(
    charge_w=st.floats(), discharge_w=st.floats(), engine_w=st.floats(), soc=st.floats(),
    waited_s=st.floats(), power_w=st.floats(), on=st.booleans(),
)  # fmt: skip
def test_no_limit_is_beyond_the_powertrain(
    charge_w, discharge_w, engine_w, soc, waited_s, power_w, on
):
    seen = replace(
        observation(1e5, charge_w, discharge_w, engine_w),
        soc=np.array([soc]),
        engine_on=np.array([on]),
        time_in_state_s=np.array([waited_s]),
        engine_power_w=np.array([power_w]),
    )
    made = within_powertrain(seen, FIELD, dt_s=0.1)
    for name, most_w in zip(LIMITS, (150e3, 150e3, 275e3), strict=True):
        limit_w, said_w = getattr(made, name)[0], getattr(seen, name)[0]
        assert 0.0 <= limit_w <= most_w
        assert not limit_w > max(said_w, 0.0)


def test_limits_that_nobody_measures_are_the_powertrains_own_at_the_observed_state():
    seen = replace(
        observation(1e5, math.inf, math.inf, math.inf),
        soc=np.array([FIELD.battery.soc_max]),
        engine_on=np.ones(1, bool),
        engine_power_w=np.array([50e3]),
    )
    made = within_powertrain(seen, FIELD, dt_s=0.1)
    assert made.charge_limit_w[0] == 0.0 and made.discharge_limit_w[0] == 150e3
    assert 54e3 < made.engine_limit_w[0] < 58e3  # 0.1 s of 60 kW/s at the crankshaft
    full = within_powertrain(seen, FIELD)
    assert full.engine_limit_w[0] > 100e3  # the powertrain's own step of 1 s


def test_published_limits_below_the_powertrains_own_stay():
    seen = observation(1e5, 10e3, 20e3, 30e3)
    made = within_powertrain(
        replace(seen, soc=np.array([0.5]), time_in_state_s=np.ones(1) * 60), FIELD
    )
    assert [getattr(made, name)[0] for name in LIMITS] == [10e3, 20e3, 30e3]
