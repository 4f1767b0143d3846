"""The condition machine: every transition, and what clocks and floods must not do to it."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.supervisor import (
    CONDITION_TEXT,
    REASON_TEXT,
    Condition,
    SupervisorConfig,
    SupervisorState,
    bad,
    command_reason,
    describe,
    elapsed,
    fault,
    good,
    lost,
    reset,
)
from tractor_msgs_py.types import Reason

CONFIG = SupervisorConfig(timeout_s=1.0, recover_after=3, fault_after=5)
INIT, NOMINAL, STALE, RECOVERING, FAULT = Condition
WRONG = Reason.OBSERVATION_IMPLAUSIBLE


def after(events: str, config: SupervisorConfig = CONFIG, dt_s: float = 0.1) -> SupervisorState:
    """The state after events ``dt_s`` apart: g good, b bad, w a wait of 1.5 timeouts, x a look at
    the clock, l lost, f fault, 0 reset."""
    state, now_s = reset(), 100.0
    for event in events:
        now_s += 1.5 * config.timeout_s if event == "w" else dt_s
        match event:
            case "g":
                state = good(config, state, now_s)
            case "b":
                state = bad(config, state, now_s, WRONG)
            case "w" | "x":
                state = elapsed(config, state, now_s)
            case "l":
                state = lost(state, Reason.SHUTDOWN)
            case "f":
                state = fault(state, Reason.POLICY_ERROR)
            case "0":
                state = reset()
    return state


@pytest.mark.parametrize(
    ("events", "condition", "reason"),
    [
        ("", INIT, Reason.NOT_STARTED),
        ("w", INIT, Reason.NOT_STARTED),
        ("b", INIT, Reason.NOT_STARTED),
        ("l", INIT, Reason.NOT_STARTED),
        ("f", FAULT, Reason.POLICY_ERROR),
        ("g", NOMINAL, Reason.NONE),
        ("bbbbg", NOMINAL, Reason.NONE),
        ("bbbbb", FAULT, WRONG),
        ("gx", NOMINAL, Reason.NONE),
        ("gg", NOMINAL, Reason.NONE),
        ("gb", NOMINAL, Reason.NONE),
        ("gw", STALE, Reason.OBSERVATION_STALE),
        ("gbw", STALE, WRONG),
        ("gbgw", STALE, Reason.OBSERVATION_STALE),
        ("gl", STALE, Reason.SHUTDOWN),
        ("gf", FAULT, Reason.POLICY_ERROR),
        ("gwx", STALE, Reason.OBSERVATION_STALE),
        ("gwb", STALE, WRONG),
        ("gwl", STALE, Reason.SHUTDOWN),
        ("gwf", FAULT, Reason.POLICY_ERROR),
        ("gwg", RECOVERING, Reason.RECOVERING),
        ("gwgg", RECOVERING, Reason.RECOVERING),
        ("gwggg", NOMINAL, Reason.NONE),
        ("gwgx", RECOVERING, Reason.RECOVERING),
        ("gwggb", STALE, WRONG),
        ("gwggw", STALE, Reason.OBSERVATION_STALE),
        ("gwggl", STALE, Reason.SHUTDOWN),
        ("gwggf", FAULT, Reason.POLICY_ERROR),
        ("gwggbggg", NOMINAL, Reason.NONE),
        ("gwggbgg", RECOVERING, Reason.RECOVERING),
        ("fg", FAULT, Reason.POLICY_ERROR),
        ("fb", FAULT, Reason.POLICY_ERROR),
        ("fw", FAULT, Reason.POLICY_ERROR),
        ("fl", FAULT, Reason.POLICY_ERROR),
        ("bbbbbf", FAULT, WRONG),
        ("f0", INIT, Reason.NOT_STARTED),
        ("f0g", NOMINAL, Reason.NONE),
        ("gw0g", NOMINAL, Reason.NONE),
    ],
)
def test_every_transition(events, condition, reason):
    state = after(events)
    assert (state.condition, state.reason) == (condition, reason)
    assert state.nominal == (condition is NOMINAL)


def test_silence_is_noticed_by_a_good_one_too():
    state = good(CONFIG, good(CONFIG, reset(), 10.0), 11.2)
    assert state.condition is RECOVERING


def test_the_timeout_itself_is_not_yet_silence():
    state = good(CONFIG, reset(), 10.0)
    assert elapsed(CONFIG, state, 11.0).condition is NOMINAL
    assert elapsed(CONFIG, state, 11.0 + 1e-6).condition is STALE


def test_bad_ones_do_not_prolong_what_good_ones_began():
    assert after("gbbbb", dt_s=0.3).condition is STALE


@pytest.mark.parametrize("share", ["gb", "ggb"])
def test_a_source_that_is_bad_too_often_is_a_fault_though_never_silent(share):
    assert after(share * 60).condition is FAULT


@pytest.mark.parametrize("share", ["gggb", "ggggb"])
def test_rare_bad_ones_never_add_up(share):
    assert after(share * 200).condition is NOMINAL


def test_without_a_limit_nothing_latches_and_nothing_is_owed():
    config = SupervisorConfig(1.0, recover_after=2, fault_after=0)
    assert after("g" + "b" * 1000 + "gg", config).condition is NOMINAL


def test_one_good_one_recovers_where_one_is_enough():
    assert after("gwg", SupervisorConfig(1.0, recover_after=1)).condition is NOMINAL


def test_a_flood_of_good_ones_does_not_shorten_the_recovery():
    config = SupervisorConfig(1.0, recover_after=3, good_every_s=0.1)
    state = after("gw", config)
    times_s = [200.0 + 0.001 * k for k in range(400)]
    recovered = []
    for now_s in times_s:
        state = good(config, state, now_s)
        recovered.append(state.nominal)
    assert recovered.index(True) == pytest.approx(200, abs=2)
    assert state.good_in_row == 0 and state.charge == 0


@pytest.mark.parametrize("back_s", [1e-12, 1e-6, 0.5])
def test_time_that_goes_back_by_rounding_changes_nothing(back_s):
    state = good(CONFIG, reset(), 10.0)
    state = good(CONFIG, state, 10.0 - back_s)
    assert state.condition is NOMINAL and state.good_s == 10.0
    assert elapsed(CONFIG, state, 10.0 - back_s).condition is NOMINAL


@pytest.mark.parametrize("now_s", [math.nan, math.inf, -math.inf, 5.0])
def test_a_broken_clock_is_silence_not_eternal_trust(now_s):
    assert elapsed(CONFIG, good(CONFIG, reset(), 10.0), now_s).condition is STALE


def test_a_clock_that_was_set_back_recovers_on_its_new_time():
    state = good(CONFIG, reset(), 1e6)
    for now_s in (5.0, 5.1, 5.2):
        state = good(CONFIG, state, now_s)
    assert state.condition is NOMINAL and state.good_s == 5.2


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("timeout_s", 0.0),
        ("timeout_s", math.inf),
        ("timeout_s", math.nan),
        ("recover_after", 0),
        ("fault_after", -1),
        ("good_every_s", -1.0),
        ("good_every_s", math.nan),
    ],
)
def test_a_setting_out_of_range_is_refused_by_name(field, value):
    with pytest.raises(ConfigError, match=f"^{field}: "):
        SupervisorConfig(**{"timeout_s": 1.0, field: value})


def test_everything_can_be_said_in_words():
    assert set(CONDITION_TEXT) == set(Condition) and set(REASON_TEXT) == set(Reason)
    assert describe(after("g")) == "NOMINAL: driving"
    assert describe(after("gw")).startswith("STALE: fallback law (observations stopped")
    assert command_reason(after("f")) is Reason.FAULT
    assert command_reason(after("gwg")) is Reason.RECOVERING


EVENT = st.sampled_from("gbwxl") | st.just("g") | st.just("f") | st.just("0")


@settings(max_examples=60, deadline=None)
@given(events=st.text(EVENT, max_size=60), dt_s=st.floats(0.0, 2.0))
def test_trust_needs_a_recent_good_one_and_fault_only_ends_with_a_reset(events, dt_s):
    states = [after(events[:n], dt_s=dt_s) for n in range(len(events) + 1)]
    for before, event, now in zip(states, events, states[1:], strict=False):
        if now.nominal:
            assert event in "gbx" and now.reason is Reason.NONE
        if before.condition is FAULT:
            assert now.condition is FAULT or event == "0"
        if now.condition is RECOVERING:
            assert 1 <= now.good_in_row < CONFIG.recover_after
        else:
            assert now.good_in_row == 0
        assert 0 <= now.charge <= CONFIG.fault_after * CONFIG.recover_after
