"""One way through: the ROS lockstep run, the in-process run and the replay of the recorded bag are
the same trajectory to the last bit, on the paper's whole pass and with real processes."""

import pytest

from tractor_ems.bags.check import check
from tractor_ems.bags.read import read_bag
from tractor_ems.bags.runs import observations_of, trajectory_of
from tractor_ems.drive import drive
from tractor_ems.policies.registry import make_policy, node_of
from tractor_ems.ros_run import run_ros
from tractor_ems.scenario import make_scenario
from tractor_msgs_py.trajectory import trajectory_hash


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rule_based", "default"])
def test_ros_in_process_and_replay_are_one_trajectory_twice_in_a_row(name, tmp_path):
    scenario = make_scenario("paper", "planter", 0.85, 0.836)
    policy = make_policy(name, scenario)
    (in_process,) = drive(policy, scenario.params, scenario.power_demand_w[None, :], 0.85, 0.836)
    expected = trajectory_hash(in_process)
    for attempt in ("first", "second"):
        bag = tmp_path / attempt
        result = run_ros(node_of(name, scenario), scenario, record=bag)
        assert trajectory_hash(result.trajectory) == expected
        (run,) = read_bag(bag)
        assert trajectory_hash(trajectory_of(run)) == expected
        # The bag's demand and commands on the plant give the same columns once more ...
        assert check(bag).outcome("parity") == "pass"
    # ... and the policy answers the bag's observations as it did live.
    state = policy.init(1)
    observations, refusals = observations_of(run, policy.spec)
    assert len(observations) == len(scenario.cycle)
    assert not [reason for reason in refusals if reason != "repeated_or_old_stamp"]
    for observation in observations:
        command, state = policy.act(observation, state)
        recorded = run.command[observation.stamp_ns]
        assert recorded.battery_power_w == command.battery_power_w[0]
