"""Demand from a topic, at the plant's side, without ROS and without waiting."""

import math
from dataclasses import replace

import numpy as np
import pytest

from tractor_ems.drive import drive
from tractor_ems.policies.rules import RuleBased
from tractor_msgs_py.errors import CycleError, RunAborted
from tractor_msgs_py.trajectory import trajectory_hash
from tractor_msgs_py.types import (
    BatteryPowerCommand,
    DutyCycleDemand,
    DutyCycleInfo,
    PowerDemand,
)
from tractor_sim.lockstep import Lockstep
from tractor_sim.pace import Peers
from tractor_sim.plant_run import PlantRun, prepare_run
from tractor_sim.real_time import RealTime
from tractor_sim.topic_demand import TopicDemand

DEMAND_W = (60e3, 150e3, 200e3, 90e3, 20e3, 180e3)
INFO = DutyCycleInfo("one", "short", "0" * 64, 10**12, 1.0, len(DEMAND_W))
READY = Peers(1, 1, True)


def topic_run(mode="lockstep", powertrain="paper") -> tuple[PlantRun, TopicDemand]:
    run = prepare_run(powertrain, INFO, mode=mode)
    return run, TopicDemand(run, INFO, timeout_s=5.0)


def offer(demand: TopicDemand, *steps: int) -> None:
    for k in steps:
        demand.offer(DutyCycleDemand(INFO.stamp_ns(k), DEMAND_W[k]))


def answer(run: PlantRun, power_w: float = 0.0) -> BatteryPowerCommand:
    return BatteryPowerCommand(run.stamp_ns, power_w)


def demand_in(samples) -> list[float]:
    return [sample.power_w for sample in samples if isinstance(sample, PowerDemand)]


def test_lockstep_publishes_no_tick_before_its_demand_and_goes_on_when_it_comes():
    run, demand = topic_run()
    pace = Lockstep(run, answer_timeout_s=5.0)
    assert pace.start(replace(READY, demand_ready=run.ready), 0.0) == ()
    assert "no duty_cycle_demand" in pace.gate.missing
    offer(demand, 0)
    assert demand_in(pace.start(replace(READY, demand_ready=run.ready), 1.0)) == [DEMAND_W[0]]
    assert pace.offer(answer(run), 1, 1.0) == ()
    assert pace.poll(1, 1e6) == (), "waiting for demand is not the policy's fault"
    assert pace.offer(answer(run), 1, 1e6) == () and run.k == 1, "answered a tick that is not out"
    offer(demand, 1)
    assert demand_in(pace.poll(1, 1e6)) == [DEMAND_W[1]]


@pytest.mark.parametrize("powertrain", ["paper", "field"])
def test_a_run_on_demand_from_a_topic_is_the_run_on_the_cycle_to_the_last_bit(powertrain):
    run, demand = topic_run(powertrain=powertrain)
    offer(demand, *range(len(DEMAND_W)))
    soc, policy = run.info.soc_initial, RuleBased(run.params)
    bus_w = np.array([DEMAND_W]) + run.params.p_aux_w
    (expected,) = drive(policy, run.params, bus_w, soc, run.info.soc_target)
    commands = zip(expected.command_battery_power_w, expected.command_engine_power_w, strict=True)
    for command in commands:
        run.apply(BatteryPowerCommand(run.stamp_ns, *map(float, command)))
    assert trajectory_hash(run.trajectory()) == trajectory_hash(expected)


def test_real_time_holds_the_newest_demand_and_counts_it():
    run, demand = topic_run("real_time")
    pace = RealTime(run, period_s=1.0, command_timeout_s=2.0)
    offer(demand, 0)
    assert demand_in(pace.start(READY, 0.0)) == [DEMAND_W[0]]
    assert demand_in(pace.poll(1, 1.0)) == [DEMAND_W[0]], "tick 1 has no demand: tick 0's is held"
    offer(demand, 1)  # late: what tick 2 holds
    assert demand_in(pace.poll(1, 2.0)) == [DEMAND_W[1]]
    offer(demand, 0, 2, 2, 3)
    assert demand_in(pace.poll(1, 3.0)) == [DEMAND_W[3]]
    assert pace.counters["demand_held"] == 2
    assert pace.counters["demand_late"] == 2
    assert pace.counters["demand_repeated"] == 2


@pytest.mark.parametrize(
    ("stamp_ns", "power_w", "counter"),
    [
        (INFO.stamp_ns(0) + 1, 1e3, "demand_other_stamp"),
        (INFO.stamp_ns(-1), 1e3, "demand_other_stamp"),
        (INFO.stamp_ns(INFO.steps), 1e3, "demand_other_stamp"),
        (0, 1e3, "demand_other_stamp"),
        (INFO.stamp_ns(0), math.nan, "demand_out_of_range"),
        (INFO.stamp_ns(0), -math.inf, "demand_out_of_range"),
        (INFO.stamp_ns(0), 2e9, "demand_out_of_range"),
    ],
)
def test_demand_of_no_step_or_of_no_power_is_counted_and_never_driven(stamp_ns, power_w, counter):
    run, demand = topic_run()
    demand.offer(DutyCycleDemand(stamp_ns, power_w))
    assert run.demand_counters == {counter: 1} and not run.ready


@pytest.mark.parametrize("mode", ["lockstep", "real_time"])
def test_demand_that_stays_away_ends_the_run_with_the_tick_that_misses_it(mode):
    run, demand = topic_run(mode)
    demand.check(0, driving=False, now_s=1e3)  # before the start nobody is late
    offer(demand, 0)
    demand.check(1, driving=True, now_s=2e3)
    run.apply(answer(run))
    demand.check(0, driving=True, now_s=2e3 + 5.0)
    with pytest.raises(RunAborted, match=r"no duty_cycle_demand of tick 1 .* 0 publishers on"):
        demand.check(0, driving=True, now_s=2e3 + 5.1)


def test_a_player_that_goes_before_the_first_tick_ends_the_run_and_one_that_waits_does_not():
    _, demand = topic_run()
    for now_s in (0.0, 1e3):
        demand.check(1, driving=False, now_s=now_s)
    demand.check(0, driving=False, now_s=1e3 + 5.0)
    with pytest.raises(RunAborted, match=r"tick 0 .*0 publishers"):
        demand.check(0, driving=False, now_s=1e3 + 5.1)


def test_a_finished_run_misses_no_player():
    run, demand = topic_run()
    offer(demand, *range(len(DEMAND_W)))
    while not run.done:
        run.apply(answer(run))
    demand.announce(replace(INFO, replay_id="two"))
    demand.check(2, driving=True, now_s=1e6)
    assert run.ready and run.closing_samples()


def test_a_second_player_ends_the_run():
    _, demand = topic_run()
    with pytest.raises(RunAborted, match="2 publishers on duty_cycle_demand, allowed 1"):
        demand.check(2, driving=False, now_s=0.0)


def test_another_replay_ends_the_run_and_the_same_again_does_not():
    _, demand = topic_run()
    demand.announce(replace(INFO))
    with pytest.raises(RunAborted, match="another replay was announced, of short"):
        demand.announce(replace(INFO, replay_id="two"))


def test_steps_that_the_powertrain_does_not_make_are_refused_with_both_lengths():
    with pytest.raises(CycleError, match=r"cycle short: dt_s 0.5, powertrain paper needs 1.0"):
        prepare_run("paper", replace(INFO, dt_s=0.5))
