"""Hand-over: no step in generator power on the way in or out, whoever asks and whenever."""

import contextlib
import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tractor_ems import handover as ho
from tractor_ems.decide import DecideConfig, Decider
from tractor_ems.handover import HandoverConfig, HandoverState, Mode
from tractor_ems.policies.protocol import ANY_RUN, limits_of
from tractor_ems.safety import vehicle_command
from tractor_msgs_py.errors import ConfigError, PolicyError
from tractor_msgs_py.observation import Observation
from tractor_msgs_py.types import CommandMode, Reason
from tractor_sim.config import load_powertrain
from tractor_sim.powertrain import Command
from tractor_sim.safe_command import bounds_w

RAMP = HandoverConfig(ramp_w_per_s=10e3)
ROUNDING_W = 1e-3


def seen(demand_w=150e3, engine_w=150e3, stamp_ns=1, limit_w=215e3):
    """An observation whose battery and engine are far from their limits."""
    one = np.ones(1)
    return Observation(
        stamp_ns=stamp_ns,
        power_demand_w=demand_w * one,
        soc=0.8 * one,
        soc_target=0.8 * one,
        engine_on=np.array([engine_w > 0.0]),
        time_in_state_s=100.0 * one,
        engine_power_w=engine_w * one,
        charge_limit_w=limit_w * one,
        discharge_limit_w=limit_w * one,
        engine_limit_w=275e3 * one,
        features=np.zeros((1, 0)),
    )


def wish(observation, battery_w, engine_w=math.nan):
    asked = Command(np.array([battery_w]), np.array([engine_w]))
    return vehicle_command(observation, asked)[0]


def test_in_the_shadow_nothing_is_commanded():
    observation = seen()
    state, command = ho.hand_over(RAMP, HandoverState(), observation, wish(observation, 9e3), 1.0)
    assert (state.mode, command) == (Mode.SHADOW, None)


def test_a_negative_ramp_is_refused_and_a_powertrain_without_one_gets_the_default():
    with pytest.raises(ConfigError, match=r"ramp_w_per_s: -1.*allowed >= 0"):
        HandoverConfig(-1.0)
    assert ho.ramp_of(math.inf) == ho.DEFAULT_RAMP_W_PER_S
    assert ho.ramp_of(25e3) == 25e3


@pytest.mark.parametrize(
    ("mode", "engaged", "disengaged"),
    [
        (Mode.SHADOW, Mode.ENGAGING, Mode.SHADOW),
        (Mode.ENGAGING, Mode.ENGAGING, Mode.DISENGAGING),
        (Mode.ENGAGED, Mode.ENGAGED, Mode.DISENGAGING),
        (Mode.DISENGAGING, Mode.ENGAGING, Mode.SHADOW),
    ],
)
def test_what_enable_does_in_every_mode(mode, engaged, disengaged):
    state = HandoverState(mode, 5e3)
    assert ho.engage(state).mode is engaged
    assert ho.disengage(state).mode is disengaged


def test_it_begins_at_what_is_applied_and_holds_until_everybody_hears():
    state = ho.engage(HandoverState())
    for heard in (False, False, True, True, True):
        observation = seen(demand_w=150e3, engine_w=90e3)
        state, command = ho.hand_over(RAMP, state, observation, wish(observation, 0.0), 1.0, heard)
        assert ho.set_point_w(observation, command) == pytest.approx(90e3)
        assert (command.mode, command.reason) == (CommandMode.NOMINAL, Reason.HANDOVER)
    state, command = ho.hand_over(RAMP, state, observation, wish(observation, 0.0), 1.0)
    assert ho.set_point_w(observation, command) == pytest.approx(100e3)


def test_it_is_engaged_once_the_wish_is_reached_and_then_jumps_as_the_policy_wants():
    state, applied_w = replace(ho.engage(HandoverState()), held=ho.HOLD_TICKS), 120e3
    reasons = []
    for _ in range(4):
        observation = seen(engine_w=applied_w)
        state, command = ho.hand_over(RAMP, state, observation, wish(observation, 0.0), 1.0)
        reasons.append(command.reason)
        applied_w = ho.set_point_w(observation, command)
    assert state.mode is Mode.ENGAGED
    assert reasons == [Reason.HANDOVER, Reason.HANDOVER, Reason.NONE, Reason.NONE]
    state, command = ho.hand_over(RAMP, state, observation, wish(observation, 100e3), 1.0)
    assert ho.set_point_w(observation, command) == pytest.approx(50e3)


def test_ramp_always_holds_while_engaged_too():
    config, observation = replace(RAMP, always=True), seen()
    state = HandoverState(Mode.ENGAGED, 150e3)
    state, command = ho.hand_over(config, state, observation, wish(observation, 100e3), 1.0)
    assert ho.set_point_w(observation, command) == pytest.approx(140e3)
    assert state.mode is Mode.ENGAGED


def test_engine_off_waits_for_the_ramp():
    state, applied_w = replace(ho.engage(HandoverState()), held=ho.HOLD_TICKS), 25e3
    powers = []
    for _ in range(3):
        observation = seen(demand_w=30e3, engine_w=applied_w)
        off = wish(observation, 30e3, 0.0)
        state, command = ho.hand_over(RAMP, state, observation, off, 1.0)
        applied_w = ho.set_point_w(observation, command)
        powers.append((applied_w, command.engine_power_w == 0.0))
    assert powers == [(15e3, False), (5e3, False), (0.0, True)]


def test_it_leaves_with_the_fallback_law():
    observation, state = seen(engine_w=135e3), HandoverState(Mode.DISENGAGING, 135e3)
    state, command = ho.hand_over(RAMP, state, observation, wish(observation, 99e3), 1.0)
    assert (command.mode, command.reason) == (CommandMode.NOMINAL, Reason.HANDOVER)
    assert ho.set_point_w(observation, command) == pytest.approx(145e3)
    observation = seen(engine_w=145e3)
    state, command = ho.hand_over(RAMP, state, observation, wish(observation, 99e3), 1.0)
    assert (command.mode, command.reason) == (CommandMode.FALLBACK, Reason.HANDOVER)
    assert command.battery_power_w == 0.0 and state == HandoverState()


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.sampled_from(["tick", "tick", "tick", "engage", "disengage", "deaf"]),
            st.floats(-100e3, 400e3),
            st.floats(-300e3, 300e3),
            st.floats(0.0, 250e3),
        ),
        max_size=40,
    )
)
def test_no_step_beyond_the_ramp_but_for_what_is_infeasible(events):
    state, applied_w = HandoverState(), 0.0
    for what, demand_w, wished_w, limit_w in events:
        if what in ("engage", "disengage"):
            state = getattr(ho, what)(state)
        observation = seen(demand_w, applied_w, limit_w=limit_w)
        before, heard = state, what != "deaf"
        state, command = ho.hand_over(
            RAMP, state, observation, wish(observation, wished_w), 0.1, heard
        )
        if command is None:
            assert before.mode is Mode.SHADOW
            continue
        power_w = ho.set_point_w(observation, command)
        lowest = vehicle_command(observation, Command(np.array([1e9]), np.array([math.nan])))[0]
        highest = vehicle_command(observation, Command(np.array([-1e9]), np.array([math.nan])))[0]
        bounds = [ho.set_point_w(observation, bound) for bound in (lowest, highest)]
        assert bounds[0] - ROUNDING_W <= power_w <= bounds[1] + ROUNDING_W
        if before.mode in (Mode.ENGAGING, Mode.DISENGAGING):
            from_w = before.generator_w if math.isfinite(before.generator_w) else applied_w
            near = min(max(from_w, bounds[0]), bounds[1])
            most_w = max(abs(near - from_w), RAMP.ramp_w_per_s * 0.1) + ho.REACHED_W
            assert abs(power_w - from_w) <= most_w + ROUNDING_W
        applied_w = power_w


def test_a_command_that_came_too_late_does_not_make_the_next_step_twice_as_large():
    step_w, state = RAMP.ramp_w_per_s * 0.1, HandoverState(Mode.ENGAGING, 30e3, ho.HOLD_TICKS)
    said_w = []
    for applied_w in (30e3, 30e3, 30e3 + step_w, 30e3 + 2 * step_w):  # the first came too late
        observation = seen(100e3, applied_w)
        state, command = ho.hand_over(RAMP, state, observation, wish(observation, 0.0), 0.1)
        said_w.append(ho.set_point_w(observation, command) - 30e3)
    assert said_w == pytest.approx([step_w, step_w, 2 * step_w, 3 * step_w])


@pytest.mark.parametrize("mode", [Mode.ENGAGING, Mode.DISENGAGING])
def test_a_generator_that_never_follows_is_handed_over_all_the_same(mode):
    state, ticks = HandoverState(mode, 0.0, ho.HOLD_TICKS), 0
    while state.mode is mode:
        observation = seen(20e3, 0.0)
        state, _ = ho.hand_over(RAMP, state, observation, wish(observation, 0.0), 0.1)
        ticks += 1
        assert ticks < 100
    assert ticks <= 20 * (1 + ho.MOST_WAITS)


WILD = st.one_of(
    st.sampled_from([math.nan, math.inf, -math.inf, 1e308, -1e308, 0.0]), st.floats(-500e3, 500e3)
)


@dataclass
class Wild:
    """Answers what it is told to, however absurd; None raises."""

    battery_w: float | None = 0.0
    engine_power_w: float = 0.0
    name: str = "wild"
    spec: object = ANY_RUN

    def init(self, batch):
        return None

    def act(self, observation, state):
        if self.battery_w is None:
            raise ZeroDivisionError("told to")
        return Command(np.array([self.battery_w]), np.array([self.engine_power_w])), state


EVENTS = st.lists(
    st.tuples(
        st.sampled_from(["tick"] * 6 + ["engage", "disengage", "silence", "clear"]),
        WILD,
        st.one_of(st.none(), WILD),
        WILD,
        st.floats(0.0, 1.0),
    ),
    max_size=40,
)


def said(decider, what, observation, now_s):
    """The commands that one event leads to."""
    if what == "engage":
        with contextlib.suppress(PolicyError):
            decider.engage()
        return []
    if what == "disengage":
        return [decider.disengage()[0]]
    if what == "silence":
        return [decider.overdue(now_s)]
    if what == "clear":
        decider.clear()
        return []
    decision = decider.decide(observation, now_s)
    return [None if decision is None else decision.command]


@settings(max_examples=50, deadline=None)
@given(EVENTS, st.booleans())
def test_whatever_is_seen_wished_or_asked_for_what_leaves_is_finite_and_feasible(events, always):
    ramp = replace(RAMP, always=always)
    config = DecideConfig(handover=ramp, params=load_powertrain("field"), vehicle=True)
    policy, now_s = Wild(), 0.0
    decider = Decider(policy, config)
    decider.start(0.1, supervised=True)
    for k, (what, demand_w, wished_w, other_w, soc) in enumerate(events, 1):
        now_s += 3.0 if what == "silence" else 0.1
        policy.battery_w, policy.engine_power_w = wished_w, other_w
        observation = seen(demand_w, abs(other_w), k * 10**8, limit_w=abs(other_w))
        observation = replace(observation, soc=np.array([soc]))
        for command in (*said(decider, what, observation, now_s), decider.shutdown_command()):
            if command is None:
                continue
            known = decider.observation
            lb, ub = bounds_w(limits_of(known), known.power_demand_w)
            assert math.isfinite(command.battery_power_w)
            assert not math.isinf(command.engine_power_w)
            assert lb[0] - 1e-6 <= command.battery_power_w <= ub[0] + 1e-6
