"""Plant and policy nodes on one graph: parity, restarts, refusals, nothing lost."""

import math

import numpy as np
import pytest

from tractor_ems.answer import Answerer
from tractor_ems.drive import drive
from tractor_ems.nodes import ddqn_policy, dp_policy
from tractor_ems.policies.rules import Conventional, RuleBased
from tractor_msgs_py import topics
from tractor_msgs_py.errors import CycleError, PolicyError, RunAborted
from tractor_msgs_py.ros.messages import RosMessages
from tractor_msgs_py.trajectory import trajectory_hash
from tractor_msgs_py.types import BatteryPowerCommand, CommandMode, PowerDemand
from tractor_sim.config import load_powertrain
from tractor_sim.plant_run import prepare_run

PAPER = load_powertrain("paper")
DEMAND_W = [60e3, 150e3, 200e3, 90e3, 20e3, 180e3, 240e3, 105e3, 130e3, 40e3, 110e3, 150e3]
OBSERVED = (topics.RUN_INFO, topics.POWER_DEMAND, topics.BATTERY, topics.POWERTRAIN)


@pytest.fixture
def cycle(make_cycle) -> str:
    return make_cycle(DEMAND_W)


def in_process_hash(policy, soc=0.85) -> str:
    return trajectory_hash(drive(policy, PAPER, np.array([DEMAND_W]), soc, soc)[0])


def test_lockstep_equals_in_process_twice_in_a_row_and_after_a_restart_of_either(graph, cycle):
    policy = graph.policy(Answerer(RuleBased(PAPER)))
    expected = in_process_hash(RuleBased(PAPER))
    for _ in range(2):
        trajectory, result = graph.drive(graph.plant(cycle=cycle))
        assert trajectory_hash(trajectory) == result["trajectory_hash"] == expected
    graph.remove(policy._node)
    plant = graph.plant(cycle=cycle)
    graph.policy(Answerer(RuleBased(PAPER)))
    trajectory, result = graph.drive(plant)
    assert trajectory_hash(trajectory) == expected
    assert not [name for name in result["counters"] if name.startswith("refused_not_")]


@pytest.mark.parametrize("kind", ["ddqn_sampled", "ddqn_counterfactual"])
def test_learned_policy_in_its_node_equals_in_process(graph, cycle, untrained, kind):
    path, policy = untrained(kind)
    setup = ddqn_policy.prepare({"policy_file": path})
    graph.policy(Answerer(setup.policy, setup.powertrain_hash))
    trajectory, _ = graph.drive(graph.plant(cycle=cycle))
    assert trajectory_hash(trajectory) == in_process_hash(policy)


def test_a_run_names_the_command_line_it_was_given_or_else_its_own(graph, cycle, monkeypatch):
    monkeypatch.setattr("sys.argv", ["/opt/somewhere/plant_sim", "--ros-args"])
    assert graph.plant(cycle=cycle)._run.info.command_line == "plant_sim --ros-args"
    given = graph.plant(cycle=cycle, command_line="ems evaluate planter")
    assert given._run.info.command_line == "ems evaluate planter"


def dp_values(cycle) -> dict:
    defaults = {parameter.name: parameter.default for parameter in dp_policy.PARAMETERS}
    return {**defaults, "cycle": cycle, "soc_points": 51, "actions": 101}


def test_dp_node_equals_in_process_and_drives_no_other_cycle(graph, cycle, make_cycle):
    setup = dp_policy.prepare(dp_values(cycle))
    graph.policy(Answerer(setup.policy, setup.powertrain_hash, check_run=setup.check_run))
    trajectory, _ = graph.drive(graph.plant(cycle=cycle))
    assert trajectory_hash(trajectory) == in_process_hash(setup.policy)
    other = make_cycle(DEMAND_W[::-1], "other")
    with pytest.raises(CycleError, match=r"the run drives cycle other .*, solved was short"):
        graph.drive(graph.plant(cycle=other))


def test_dp_node_refuses_a_run_with_another_target(graph, cycle):
    setup = dp_policy.prepare(dp_values(cycle))
    graph.policy(Answerer(setup.policy, setup.powertrain_hash, check_run=setup.check_run))
    with pytest.raises(PolicyError, match=r"should end at SOC 0.84, solved was 0.85"):
        graph.drive(graph.plant(cycle=cycle, soc_target=0.84))


def test_dp_node_stops_at_the_first_demand_that_differs(graph, cycle):
    setup = dp_policy.prepare(dp_values(cycle))
    graph.policy(Answerer(setup.policy, setup.powertrain_hash, check_run=setup.check_run))
    plant, run = graph.peer(topics.COMMAND), prepare_run("paper", cycle)
    demand, *state = run.samples()
    plant.say(run.info)
    with pytest.raises(RunAborted, match=r"tick 0: power_demand is 60001\.0 W"):
        repeat_until(graph, plant, [PowerDemand(demand.stamp_ns, 60001.0), *state])


def repeat_until(graph, plant, samples, condition=lambda: False) -> None:
    """What a plant does with an unanswered tick."""

    def again() -> bool:
        plant.say(*samples)
        graph.spin(10)
        return condition()

    graph.spin_until(again, "an answer")


def test_a_recorder_that_was_announced_hears_everything(graph, cycle):
    graph.policy(Answerer(RuleBased(PAPER)))
    plant = graph.plant(cycle=cycle, expected_recorders=1)
    graph.spin_until(lambda: plant._peers().command_publishers == 1, "the policy")
    graph.spin(20)
    assert plant._run.k == 0, "started without its recorder"
    recorder = graph.peer(*topics.RECORDED)
    trajectory, _ = graph.drive(plant)
    stamps = [int(stamp) for stamp in trajectory.stamp_ns]
    end_ns = stamps[-1] + 1_000_000_000
    for topic in (topics.BATTERY, topics.POWERTRAIN):
        samples = recorder.heard[topic.name]
        graph.spin_until(lambda s=samples: s[-1].stamp_ns == end_ns, f"the end of {topic.name}")
    heard = {name: [] for name in recorder.heard}
    for name, samples in recorder.heard.items():
        for sample in samples:
            stamp_ns = getattr(sample, "stamp_ns", 0)
            if name != topics.RUN_INFO.name and stamp_ns not in heard[name]:
                heard[name].append(stamp_ns)
    assert heard[topics.POWER_DEMAND.name] == heard[topics.COMMAND.name] == stamps
    for topic in (topics.BATTERY, topics.POWERTRAIN):
        assert heard[topic.name] == [*stamps, end_ns]
    assert {info.run_id for info in recorder.heard[topics.RUN_INFO.name]} == {
        plant._run.info.run_id
    }


def test_commands_that_are_no_answer_are_refused_and_counted_and_the_run_goes_on(graph, cycle):
    policy = graph.peer(*OBSERVED)
    malformed = RosMessages().joint_state(1, ["battery_power"], [0.0])
    answered = []

    def answer(sample) -> None:
        if not isinstance(sample, PowerDemand) or sample.stamp_ns in answered:
            return
        k = len(answered)
        stamp_ns = sample.stamp_ns
        if k == 1:
            policy.publisher(topics.COMMAND).publish(malformed)
            policy.say(BatteryPowerCommand(stamp_ns + 1, 0.0))
            policy.say(BatteryPowerCommand(stamp_ns, 0.0, mode=CommandMode.FALLBACK))
            policy.say(BatteryPowerCommand(stamp_ns, 0.0, mode=CommandMode.SHUTDOWN))
        wanted_w = {2: math.nan, 3: math.inf, 4: 1e30}.get(k, 0.0)
        policy.say(BatteryPowerCommand(stamp_ns, wanted_w))
        answered.append(stamp_ns)

    policy.on_sample = answer
    policy.publisher(topics.COMMAND)
    trajectory, result = graph.drive(graph.plant(cycle=cycle))
    assert len(answered) == len(trajectory) == len(DEMAND_W)
    refused = {name: n for name, n in result["counters"].items() if name.startswith("refused_")}
    refused.pop("refused_repeated_answer", None)
    assert refused == {
        "refused_malformed": 1,
        "refused_other_stamp": 1,
        "refused_fallback_mode": 1,
        "refused_shutdown_mode": 1,
        "refused_not_finite": 2,
        "refused_out_of_range": 1,
    }
    assert np.all(np.isfinite(trajectory.battery_power_w))


def test_what_is_malformed_or_not_finite_is_refused_counted_and_shown(graph, cycle):
    graph.policy(Answerer(RuleBased(PAPER)))
    plant = graph.peer(topics.COMMAND, topics.DIAGNOSTICS)
    run = prepare_run("paper", cycle)
    demand, *state = run.samples()
    broken = RosMessages().joint_state(demand.stamp_ns, ["torque"], [1.0])
    plant.publisher(topics.RUN_INFO).publish(RosMessages().string('{"run_id": 1}'))

    def counters() -> dict[str, str]:
        shown = plant.heard[topics.DIAGNOSTICS.name]
        return {item.key: item.value for item in shown[-1].status[0].values} if shown else {}

    graph.spin_until(lambda: "refused_malformed_run_info" in counters(), "the first count")
    plant.say(run.info)
    repeat_until(
        graph,
        plant,
        [PowerDemand(demand.stamp_ns, math.nan), *state],
        lambda: "refused_not_finite" in counters(),
    )
    plant.publisher(topics.POWERTRAIN).publish(broken)
    graph.spin_until(lambda: "refused_malformed_powertrain_state" in counters(), "the last count")
    assert plant.heard[topics.COMMAND.name] == []
    plant.say(demand, *state)
    graph.spin_until(lambda: plant.heard[topics.COMMAND.name], "the answer")
    assert plant.heard[topics.COMMAND.name][0].battery_power_w == 60e3


def test_a_second_policy_ends_the_run(graph, cycle):
    plant = graph.plant(cycle=cycle)
    graph.policy(Answerer(RuleBased(PAPER)), "one_policy")
    graph.policy(Answerer(Conventional()), "other_policy")
    with pytest.raises(RunAborted, match="2 publishers on battery_power_command, allowed 1"):
        graph.drive(plant)


def test_no_policy_within_the_match_timeout_ends_the_run(graph, cycle):
    with pytest.raises(RunAborted, match=r"not started within 0.2 s: 0 of 1 publishers"):
        graph.drive(graph.plant(cycle=cycle, match_timeout_s=0.2))


def test_a_plant_without_a_policy_says_for_whom_it_waits(graph, cycle):
    people = graph.peer(topics.DIAGNOSTICS)
    graph.plant(cycle=cycle)
    shown = people.heard[topics.DIAGNOSTICS.name]
    graph.spin_until(lambda: shown, "diagnostics")
    (status,) = shown[-1].status
    assert status.message.startswith("waiting: 0 of 1 publishers on battery_power_command")
    values = {item.key: item.value for item in status.values}
    assert (values["mode"], values["tick"], values["steps"]) == ("lockstep", "0", "12")


def test_a_policy_for_another_powertrain_refuses_the_run(graph, cycle):
    graph.policy(Answerer(Conventional(), powertrain_hash="0" * 64))
    with pytest.raises(PolicyError, match="conventional was made for powertrain 0000"):
        graph.drive(graph.plant(cycle=cycle))


def test_a_policy_that_leaves_says_so_and_is_not_obeyed(graph, cycle):
    node = graph.policy(Answerer(RuleBased(PAPER)))
    plant, run = graph.peer(topics.COMMAND), prepare_run("paper", cycle)
    plant.say(run.info)
    commands = plant.heard[topics.COMMAND.name]
    repeat_until(graph, plant, run.samples(), lambda: commands)
    node.shutdown()
    graph.spin_until(lambda: commands[-1].mode is CommandMode.SHUTDOWN, "the safe command")
    assert commands[-1].battery_power_w == 0.0
