"""A learned policy as a node, from its policy file alone.

Needs rclpy, the message packages, numpy and safetensors, and nothing else at run time: the
powertrain's limits come from the policy file.
"""

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tractor_ems.nodes.policy_node import PolicySetup, run_policy_node
from tractor_ems.policies.made import load_made
from tractor_msgs_py.ros.shell import Parameter
from tractor_sim.powertrain_json import powertrain_hash
from tractor_sim.resources import resource_path

PARAMETERS = (
    Parameter("policy_file", "", "policy file (.safetensors), empty for the shipped paper policy"),
)


def prepare(values: Mapping[str, Any]) -> PolicySetup:
    """The policy in the named file, or the one that ships."""
    named = values["policy_file"]
    path = Path(named) if named else resource_path("data", "policy", "paper.safetensors")
    policy = load_made(path)
    return PolicySetup(policy, powertrain_hash(policy.params), params=policy.params)


def main() -> int:
    """Entry point."""
    return run_policy_node("ddqn_policy", PARAMETERS, prepare)


if __name__ == "__main__":
    sys.exit(main())
