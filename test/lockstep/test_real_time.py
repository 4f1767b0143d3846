"""The plant's side in real time: fresh commands are held, everything else is the fallback law."""

import math

import pytest

from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.types import BatteryPowerCommand, CommandMode, Reason
from tractor_sim.pace import Peers
from tractor_sim.real_time import RealTime, held_command

EVERYONE = Peers(command_publishers=1, observation_subscribers=1, run_info_delivered=True)


@pytest.fixture
def plant(make_run) -> RealTime:
    """Steps of 1 s since time 0; commands are obeyed for 2.5 s."""
    plant = RealTime(make_run(mode="real_time"), period_s=1.0, command_timeout_s=2.5)
    assert len(plant.start(EVERYONE, 0.0)) == 3
    return plant


def command(plant, battery_power_w, ticks=0, **changes) -> BatteryPowerCommand:
    stamp_ns = plant.run.stamp_ns + ticks * plant.run.info.dt_ns
    return BatteryPowerCommand(stamp_ns, battery_power_w, **changes)


def test_a_step_is_taken_when_its_time_is_over(plant):
    assert plant.poll(1, 0.99) == ()
    samples = plant.poll(1, 1.0)
    assert {sample.stamp_ns for sample in samples} == {plant.run.info.stamp_ns(1)}
    assert plant.poll(1, 1.01) == ()


def test_a_fresh_command_is_applied(plant):
    assert plant.offer(command(plant, 10e3), 1, 0.5) == ()
    plant.poll(1, 1.0)
    assert plant.run.trajectory().battery_power_w[0] == 10e3
    assert plant.fallback_ticks == 0


def test_without_a_command_the_fallback_law_drives(plant):
    plant.poll(1, 1.0)
    assert plant.run.trajectory().battery_power_w[0] == 0.0
    assert plant.fallback_ticks == 1


def test_a_plant_on_its_fallback_law_does_not_call_that_driving(plant):
    plant.offer(command(plant, 10e3), 1, 0.5)
    assert plant.state.startswith("NOMINAL")
    plant.poll(1, 9.0)
    assert plant.state.startswith("STALE") and "fallback law" in plant.state


def test_between_commands_the_generator_holds_and_the_battery_is_the_slack(plant):
    plant.offer(command(plant, 10e3), 1, 0.5)
    plant.poll(1, 1.0)
    plant.poll(1, 2.0)
    trajectory = plant.run.trajectory()
    assert trajectory.engine_power_w[1] == trajectory.engine_power_w[0] == 50e3
    assert trajectory.battery_power_w[1] == 100e3


def test_an_engine_that_was_off_stays_off_while_its_command_is_held():
    off = BatteryPowerCommand(1, 60e3, 0.0)
    assert held_command(off, 2, 60e3, 80e3) == BatteryPowerCommand(2, 80e3, 0.0)


def test_no_command_is_held_past_its_timeout(plant):
    plant.offer(command(plant, 10e3), 1, 0.5)
    for now_s in (1.0, 2.0, 3.0):
        plant.poll(1, now_s)
    assert plant.fallback_ticks == 1
    assert plant.run.trajectory().battery_power_w[2] == 0.0


@pytest.mark.parametrize(
    ("reason", "publishers", "battery_power_w", "changes"),
    [
        ("future", 1, 10e3, {"ticks": 1}),
        ("other_run", 1, 10e3, {"ticks": -5}),
        ("not_finite", 1, math.nan, {}),
        ("not_finite", 1, math.inf, {}),
        ("fallback_mode", 1, 10e3, {"mode": CommandMode.FALLBACK}),
        ("shutdown_mode", 1, 10e3, {"mode": CommandMode.SHUTDOWN}),
        ("two_publishers", 2, 10e3, {}),
    ],
)
def test_a_command_that_must_not_be_obeyed_is_refused_and_counted(
    plant, reason, publishers, battery_power_w, changes
):
    plant.offer(command(plant, battery_power_w, **changes), publishers, 0.5)
    plant.poll(1, 1.0)
    assert plant.refusals == {reason: 1}
    assert plant.fallback_ticks == 1


def test_a_stamp_off_the_runs_grid_is_of_another_run(plant):
    stamp_ns = plant.run.stamp_ns + 1
    plant.offer(BatteryPowerCommand(stamp_ns, 0.0), 1, 0.5)
    assert plant.refusals == {"other_run": 1}


def test_an_answer_that_took_too_long_is_stale_however_new_it_arrives(plant):
    late = command(plant, 10e3)
    for now_s in (1.0, 2.0, 3.0):
        plant.poll(1, now_s)
    plant.offer(late, 1, 3.1)
    assert plant.refusals == {"stale": 1}


def test_an_older_answer_does_not_replace_a_newer_one(plant):
    old = command(plant, 10e3)
    plant.poll(1, 1.0)
    plant.offer(command(plant, 20e3), 1, 1.1)
    plant.offer(old, 1, 1.2)
    plant.poll(1, 2.0)
    assert plant.refusals == {"out_of_order": 1}
    assert plant.run.trajectory().battery_power_w[1] == 20e3


@pytest.mark.parametrize("how", ["shutdown", "second policy"])
def test_a_policy_that_hands_over_or_is_doubled_is_not_held(plant, how):
    plant.offer(command(plant, 10e3), 1, 0.5)
    if how == "shutdown":
        plant.offer(command(plant, 0.0, mode=CommandMode.SHUTDOWN), 1, 0.6)
    plant.poll(2 if how == "second policy" else 1, 1.0)
    assert plant.fallback_ticks == 1


def test_a_plant_that_was_held_up_does_not_rush(plant):
    plant.poll(1, 10.0)
    assert plant.poll(1, 10.5) == ()
    plant.poll(1, 11.0)
    assert plant.run.k == 2


def test_a_dead_policy_does_not_keep_the_run_from_its_end(plant):
    now_s = 0.0
    while not plant.done:
        now_s += 1.0
        plant.poll(0, now_s)
    assert plant.fallback_ticks == plant.run.info.steps


def test_out_of_range_is_what_engine_and_battery_together_never_give(plant):
    plant.offer(command(plant, 525.1e3), 1, 0.4)
    plant.offer(command(plant, -1e308), 1, 0.5)
    plant.poll(1, 1.0)
    assert plant.refusals == {"out_of_range": 2}
    assert plant.fallback_ticks == 1


def test_what_is_in_range_but_not_feasible_is_projected(plant):
    plant.offer(command(plant, 500e3), 1, 0.5)
    plant.poll(1, 1.0)
    assert plant.run.trajectory().battery_power_w[0] == 60e3  # all of the demand
    assert plant.fallback_ticks == 0


def test_of_a_flood_the_newest_counts_and_the_rest_is_counted(plant):
    for k in range(100):
        plant.offer(command(plant, 100.0 * k), 1, 0.001 * k)
    plant.poll(1, 1.0)
    assert plant.run.trajectory().battery_power_w[0] == 9900.0
    assert plant.refusals == {"flood": 80}
    plant.poll(1, 2.0)
    assert plant.run.trajectory().engine_power_w[1] == 60e3 - 9900.0  # nothing was queued


def test_a_policy_of_another_rate_answers_between_the_plants_ticks(plant):
    stamp_ns = plant.run.stamp_ns
    plant.offer(BatteryPowerCommand(stamp_ns, 10e3), 1, 0.1)
    plant.offer(BatteryPowerCommand(stamp_ns + 600_000_000, 20e3), 1, 0.7)
    plant.offer(BatteryPowerCommand(stamp_ns + 500_000_000, 30e3), 1, 0.8)
    plant.poll(1, 1.0)
    assert plant.run.trajectory().battery_power_w[0] == 20e3
    assert plant.refusals == {"out_of_order": 1}
    for now_s in (2.0, 3.0, 4.0):  # 2.5 s after 0.6
        plant.poll(1, now_s)
    assert plant.fallback_ticks == 1


def test_what_was_sent_before_a_hand_over_is_not_obeyed_after_it(plant):
    plant.poll(1, 1.0)
    plant.offer(command(plant, 10e3), 1, 1.1)
    plant.offer(command(plant, 0.0, mode=CommandMode.SHUTDOWN), 1, 1.2)
    plant.offer(command(plant, 20e3, ticks=-1), 1, 1.3)
    plant.poll(1, 2.0)
    assert plant.refusals == {"shutdown_mode": 1, "out_of_order": 1}
    assert plant.fallback_ticks == 2


def told(plant) -> tuple[str | int, str | int]:
    return plant.counters["condition"], plant.counters["reason"]


def test_condition_and_reason_are_told(plant):
    assert told(plant) == ("INIT", "NOT_STARTED")
    plant.offer(command(plant, 10e3), 1, 0.5)
    assert told(plant) == ("NOMINAL", "NONE")
    for now_s in (1.0, 2.0, 2.51):
        plant.poll(1, now_s)
    assert told(plant) == ("STALE", "COMMAND_STALE")
    plant.offer(command(plant, 0.0, mode=CommandMode.SHUTDOWN), 1, 2.6)
    assert told(plant) == ("STALE", "SHUTDOWN")
    said = command(plant, 0.0, mode=CommandMode.FALLBACK, reason=Reason.OBSERVATION_IMPLAUSIBLE)
    plant.offer(said, 1, 2.7)
    assert told(plant) == ("STALE", "OBSERVATION_IMPLAUSIBLE")
    plant.poll(2, 3.0)
    assert told(plant) == ("STALE", "HANDOVER")
    plant.offer(command(plant, 10e3), 1, 3.1)
    assert told(plant) == ("NOMINAL", "NONE")
    assert plant.counters["fallback_handover"] == plant.counters["fallback_ticks"] == 1


def test_refused_commands_never_latch_a_fault(plant):
    for _ in range(2000):
        plant.offer(command(plant, math.nan), 1, 0.5)
    plant.offer(command(plant, 10e3), 1, 0.6)
    assert told(plant) == ("NOMINAL", "NONE")


def test_a_policy_that_was_lost_is_obeyed_after_enough_good_ticks(make_run):
    plant = RealTime(make_run(mode="real_time"), 1.0, 1.5, recover_after=3)
    plant.start(EVERYONE, 0.0)
    plant.offer(command(plant, 10e3), 1, 0.1)
    for now_s in (1.0, 2.0):  # the second without an answer within 1.5 s
        plant.poll(1, now_s)
    fallbacks = []
    for now_s in (3.0, 4.0, 5.0):
        for _ in range(10):  # as often as it likes: ticks count
            plant.offer(command(plant, 10e3), 1, now_s - 0.5)
        plant.poll(1, now_s)
        fallbacks.append(plant.fallback_ticks)
    assert fallbacks == [2, 3, 3]


def test_the_generator_keeps_the_plants_ramp_when_the_fallback_law_takes_over(make_run):
    plant = RealTime(make_run(mode="real_time"), 1.0, 1.5, ramp_w_per_s=20e3)
    plant.start(EVERYONE, 0.0)
    now_s = 0.0
    while not plant.done:
        now_s += 1.0
        if now_s < 4.0:
            plant.offer(command(plant, -40e3), 1, now_s - 0.5)
        plant.poll(1, now_s)
    engine_w = plant.run.trajectory().engine_power_w
    assert engine_w.tolist() == [20e3, 40e3, 60e3, 80e3, 60e3, 80e3]
    assert plant.fallback_ticks == 3


@pytest.mark.parametrize("changes", [{"recover_after": 0}, {"ramp_w_per_s": -1.0}])
def test_a_setting_out_of_range_is_refused_before_the_run(make_run, changes):
    with pytest.raises(ConfigError, match=f"^{next(iter(changes))}: "):
        RealTime(make_run(mode="real_time"), 1.0, 1.5, **changes)
