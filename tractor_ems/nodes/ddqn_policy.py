"""A learned policy as a node, from its policy file alone.

Needs rclpy, the message packages, numpy and safetensors, and nothing else at run time: the
powertrain's limits come from the policy file.
"""

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tractor_ems.nodes.policy_node import PolicySetup, run_policy_node
from tractor_ems.nodes.policy_parameters import OUTSIDE
from tractor_ems.policies.envelope import stored_envelope
from tractor_ems.policies.made import load_made
from tractor_ems.policies.shipped import shipped_policy
from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.ros.shell import Parameter
from tractor_sim.powertrain_json import powertrain_hash

PARAMETERS = (
    Parameter(
        "policy_file",
        "",
        "policy file (.safetensors), empty for the one that ships for the powertrain",
    ),
    Parameter(
        "powertrain",
        "",
        "name of the powertrain whose shipped policy drives, empty for the first run's; a vehicle "
        "announces none",
    ),
    *OUTSIDE,
)


def prepare(values: Mapping[str, Any]) -> PolicySetup | None:
    """The policy in the named file, or the one that ships for the named powertrain; None where
    the run must say first which that is.

    Raises:
        PolicyError: none ships for it, or the file cannot be used.
        ConfigError: the parameters say both, or on a vehicle neither.
    """
    named, powertrain = values["policy_file"], values.get("powertrain", "")
    if named and powertrain:
        raise ConfigError(f"parameter powertrain: {powertrain!r}, not allowed beside policy_file")
    if not (named or powertrain):
        if values["signals"]:
            raise ConfigError(
                "parameter powertrain: '', a vehicle does not say which; give it or policy_file"
            )
        return None
    policy = load_made(Path(named) if named else shipped_policy(powertrain))
    return PolicySetup(
        policy,
        powertrain_hash(policy.params),
        params=policy.params,
        envelope=stored_envelope(policy.metadata),
    )


def main() -> int:
    """Entry point."""
    return run_policy_node("ddqn_policy", PARAMETERS, prepare)


if __name__ == "__main__":
    sys.exit(main())
