"""The plant's side of lockstep, without ROS and without waiting: time is an argument."""

import math

import numpy as np
import pytest

from tractor_ems.drive import drive
from tractor_ems.policies.rules import RuleBased
from tractor_msgs_py.errors import RunAborted
from tractor_msgs_py.trajectory import trajectory_hash
from tractor_msgs_py.types import BatteryPowerCommand, CommandMode
from tractor_sim.lockstep import RESEND_S, Lockstep
from tractor_sim.pace import PARTIAL_S, Peers
from tractor_sim.powertrain import Command

EVERYONE = Peers(command_publishers=1, observation_subscribers=1, run_info_delivered=True)


@pytest.fixture
def lockstep(make_run) -> Lockstep:
    """A run whose first tick is in flight since time 0."""
    lockstep = Lockstep(make_run(), answer_timeout_s=5.0)
    assert lockstep.start(EVERYONE, 0.0)
    return lockstep


def answer(lockstep, battery_power_w=0.0, **changes) -> BatteryPowerCommand:
    stamp_ns = changes.pop("stamp_ns", lockstep.run.stamp_ns)
    return BatteryPowerCommand(stamp_ns, battery_power_w, **changes)


@pytest.mark.parametrize(
    "peers",
    [
        Peers(0, 2, True),
        Peers(1, 1, True),
        Peers(1, 0, True),
        Peers(1, 2, False),
    ],
)
def test_no_tick_before_policy_and_recorders_are_connected_and_informed(make_run, peers):
    lockstep = Lockstep(make_run(expected_recorders=1), answer_timeout_s=5.0)
    assert lockstep.start(peers, 0.0) == ()
    first = lockstep.start(Peers(1, 2, True), 1e6)
    assert {sample.stamp_ns for sample in first} == {lockstep.run.info.t0_ns} and len(first) == 3


def test_a_policy_that_wants_the_demand_alone_is_served_after_a_while(make_run):
    lockstep = Lockstep(make_run(), answer_timeout_s=5.0)
    partial = Peers(1, 0, False, demand_subscribers=1)
    assert lockstep.start(partial, 0.0) == ()
    assert lockstep.start(partial, PARTIAL_S - 0.01) == ()
    assert lockstep.start(Peers(1, 0, False, demand_subscribers=0), PARTIAL_S) == ()
    assert lockstep.start(partial, 10.0) == ()
    assert len(lockstep.start(partial, 10.0 + PARTIAL_S)) == 3


def test_nobody_within_the_match_timeout_ends_the_run_and_says_who_is_missing(make_run):
    lockstep = Lockstep(make_run(), answer_timeout_s=5.0, match_timeout_s=10.0)
    assert lockstep.start(Peers(0, 0, False), 100.0) == ()
    assert lockstep.start(Peers(0, 0, False), 110.0) == ()
    with pytest.raises(RunAborted, match="within 10 s: 0 of 1 publishers on battery_power_comma"):
        lockstep.start(Peers(0, 0, False), 110.1)


def test_the_echoing_command_is_applied_exactly_and_the_next_tick_goes_out(lockstep):
    t0_ns = lockstep.run.stamp_ns
    samples = lockstep.offer(answer(lockstep, 12345.678), 1, 0.1)
    assert {sample.stamp_ns for sample in samples} == {t0_ns + lockstep.run.info.dt_ns}
    assert lockstep.run.trajectory().battery_power_w[0] == 12345.678
    assert not lockstep.refusals


@pytest.mark.parametrize(
    ("reason", "steps", "changes"),
    [
        ("other_stamp", 1, {"stamp_ns": -1}),
        ("other_stamp", 1, {"stamp_ns": 1}),
        ("other_stamp", 2, {"stamp_ns": 0}),
        ("repeated_answer", -1, {}),
        ("fallback_mode", 0, {"mode": CommandMode.FALLBACK}),
        ("shutdown_mode", 0, {"mode": CommandMode.SHUTDOWN}),
    ],
)
def test_a_command_that_is_no_answer_to_this_tick_is_refused_and_counted(
    lockstep, reason, steps, changes
):
    lockstep.offer(answer(lockstep), 1, 0.1)
    k = lockstep.run.k
    offset_ns = steps * lockstep.run.info.dt_ns + changes.pop("stamp_ns", 0)
    command = answer(lockstep, stamp_ns=lockstep.run.stamp_ns + offset_ns, **changes)
    assert lockstep.offer(command, 1, 0.2) == ()
    assert lockstep.run.k == k
    assert lockstep.refusals == {reason: 1}


def test_a_command_before_the_start_is_refused(make_run):
    lockstep = Lockstep(make_run(), answer_timeout_s=5.0)
    assert lockstep.offer(answer(lockstep), 1, 0.0) == ()
    assert lockstep.refusals == {"no_tick_in_flight": 1} and lockstep.run.k == 0


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_an_answer_that_is_not_finite_is_counted_and_driven_by_the_fallback_law(lockstep, value):
    lb, ub = lockstep.run.feasible_w()
    assert lockstep.offer(answer(lockstep, value), 1, 0.1)
    assert lockstep.refusals == {"not_finite": 1}
    assert lockstep.run.trajectory().battery_power_w[0] == min(max(0.0, lb), ub)


@pytest.mark.parametrize("value", [1e30, -1e30, 60e3 + 1.0])
def test_an_answer_out_of_range_is_counted_and_projected(lockstep, value):
    lb, ub = lockstep.run.feasible_w()
    assert lockstep.offer(answer(lockstep, value), 1, 0.1)
    assert lockstep.refusals == {"out_of_range": 1}
    assert lockstep.run.trajectory().battery_power_w[0] == min(max(value, lb), ub)


def test_an_unanswered_tick_is_repeated_unchanged(lockstep):
    first = lockstep.run.samples()
    assert lockstep.poll(1, 0.5 * RESEND_S) == ()
    assert lockstep.poll(1, RESEND_S) == first
    assert lockstep.poll(1, 1.5 * RESEND_S) == ()
    assert lockstep.poll(1, 2.5 * RESEND_S) == first
    assert lockstep.resends == 2


def test_no_answer_within_the_timeout_ends_the_run_and_names_the_tick(lockstep):
    lockstep.offer(answer(lockstep), 1, 3.0)
    assert lockstep.poll(1, 8.0)
    with pytest.raises(RunAborted, match=r"no answer to tick 1 \(stamp \d+ ns\) within 5 s"):
        lockstep.poll(0, 8.1)


def test_a_second_policy_ends_the_run_whenever_it_shows(make_run, lockstep):
    reason = "2 publishers on battery_power_command, allowed 1"
    with pytest.raises(RunAborted, match=reason):
        Lockstep(make_run(), 5.0).start(Peers(2, 2, True), 0.0)
    with pytest.raises(RunAborted, match=reason):
        lockstep.poll(2, 0.1)
    with pytest.raises(RunAborted, match=reason):
        lockstep.offer(answer(lockstep), 2, 0.1)


def test_late_commands_after_the_last_step_change_nothing(lockstep):
    while not lockstep.done:
        final = lockstep.offer(answer(lockstep), 1, 0.1)
    assert len(final) == 2
    before = trajectory_hash(lockstep.run.trajectory())
    assert lockstep.offer(answer(lockstep), 1, 0.2) == ()
    assert lockstep.offer(answer(lockstep), 2, 0.3) == (), "a policy that came after the end"
    assert trajectory_hash(lockstep.run.trajectory()) == before


def test_same_commands_give_the_hash_of_the_in_process_run(make_run):
    lockstep = Lockstep(make_run(), 5.0)
    run = lockstep.run
    lockstep.start(EVERYONE, 0.0)
    demand_w = run.power_demand_w[None]
    expected = drive(RuleBased(run.params), run.params, demand_w, 0.85, 0.85)[0]
    for battery_w, engine_w in zip(
        expected.command_battery_power_w, expected.command_engine_power_w, strict=True
    ):
        lockstep.offer(answer(lockstep, battery_w, engine_power_w=engine_w), 1, 0.1)
    assert trajectory_hash(run.trajectory()) == trajectory_hash(expected)
    assert not lockstep.refusals


def test_an_answer_that_is_not_finite_is_driven_as_in_process(make_run):
    class Broken:
        name = "broken"
        spec = RuleBased(make_run().params).spec

        def init(self, batch):
            return None

        def act(self, observation, state):
            nothing = np.full(1, np.nan)
            return Command(nothing, nothing), state

    lockstep = Lockstep(make_run(), 5.0)
    run = lockstep.run
    lockstep.start(EVERYONE, 0.0)
    while not lockstep.done:
        lockstep.offer(answer(lockstep, math.nan), 1, 0.1)
    expected = drive(Broken(), run.params, run.power_demand_w[None], 0.85, 0.85)[0]
    driven = run.trajectory()  # the command differs: a node would have made it safe
    for column in ("battery_power_w", "engine_power_w", "fuel_kg", "soc", "engine_on"):
        np.testing.assert_array_equal(getattr(driven, column), getattr(expected, column))
