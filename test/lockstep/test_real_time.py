"""The plant's side in real time: fresh commands are held, everything else is the fallback law."""

import math

import pytest

from tractor_msgs_py.types import BatteryPowerCommand, CommandMode
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
