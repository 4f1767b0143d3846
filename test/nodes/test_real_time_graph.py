"""Real time on one graph: the plant goes on without its policy, the policy notices silence."""

import math

import pytest

from tractor_ems.answer import Answerer
from tractor_ems.policies.rules import RuleBased
from tractor_msgs_py import topics
from tractor_msgs_py.types import BatteryPowerCommand, CommandMode, PowerDemand
from tractor_sim.config import load_powertrain
from tractor_sim.plant_run import prepare_run

PAPER = load_powertrain("paper")


@pytest.fixture
def cycle(make_cycle) -> str:
    return make_cycle([150e3] * 30)


def test_plant_falls_back_when_the_policy_stops_and_drives_to_the_end(graph, cycle):
    policy = graph.policy(Answerer(RuleBased(PAPER)))
    plant = graph.plant(cycle=cycle, mode="real_time", period_s=0.05, command_timeout_s=0.2)
    graph.spin_until(lambda: plant._run.k > 5, "a few steps")
    assert plant._pace.fallback_ticks < 5
    graph.remove(policy._node)
    trajectory, result = graph.drive(plant)
    assert len(trajectory) == 30
    assert result["counters"]["fallback_ticks"] > 5
    assert trajectory.battery_power_w[-1] == 0.0
    assert not result["lockstep"]


def test_plant_looks_again_before_its_step_is_over(graph, cycle):
    graph.policy(Answerer(RuleBased(PAPER)))
    plant = graph.plant(cycle=cycle, mode="real_time", period_s=0.006)
    graph.spin_until(lambda: plant._run.k > 1, "a step")
    assert min(timer.timer_period_ns for timer in plant._node.timers) < 6_000_000


def test_plant_obeys_one_policy_only(graph, cycle):
    graph.policy(Answerer(RuleBased(PAPER)), "one_policy")
    plant = graph.plant(cycle=cycle, mode="real_time", period_s=0.05, command_timeout_s=0.2)
    graph.spin_until(lambda: plant._run.k > 2, "a few steps")
    graph.policy(Answerer(RuleBased(PAPER)), "other_policy")
    _, result = graph.drive(plant)
    assert result["counters"]["refused_two_publishers"] > 0
    assert result["counters"]["fallback_ticks"] > 0


def test_plant_refuses_what_is_not_finite_of_the_future_or_of_another_run(graph, cycle):
    policy = graph.peer(topics.RUN_INFO, topics.POWER_DEMAND, topics.BATTERY, topics.POWERTRAIN)
    policy.publisher(topics.COMMAND)

    def answer(sample) -> None:
        if not isinstance(sample, PowerDemand):
            return
        policy.say(
            BatteryPowerCommand(sample.stamp_ns, math.nan),
            BatteryPowerCommand(sample.stamp_ns + 10_000_000_000, 1e3),
            BatteryPowerCommand(1, 1e3),
        )

    policy.on_sample = answer
    trajectory, result = graph.drive(graph.plant(cycle=cycle, mode="real_time", period_s=0.02))
    for reason in ("not_finite", "future", "other_run"):
        assert result["counters"][f"refused_{reason}"] > 0
    assert result["counters"]["fallback_ticks"] == len(trajectory)
    assert not trajectory.battery_power_w.any()


def test_policy_sends_the_fallback_law_when_the_plant_goes_silent(graph, cycle):
    graph.policy(Answerer(RuleBased(PAPER), observation_timeout_s=0.3))
    plant = graph.peer(topics.COMMAND)
    run = prepare_run("paper", cycle, mode="real_time")
    commands = plant.heard[topics.COMMAND.name]
    plant.say(run.info)

    def observed() -> bool:
        if not commands:
            plant.say(*run.samples())
        graph.spin(5)
        return bool(commands)

    graph.spin_until(observed, "an answer")
    graph.spin_until(lambda: commands[-1].mode is CommandMode.FALLBACK, "the fallback command")
    assert commands[-1].battery_power_w == 0.0
    assert commands[0].mode is CommandMode.NOMINAL
