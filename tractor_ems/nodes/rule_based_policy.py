"""The rule policies as a node; ``policy`` chooses which."""

import sys
from collections.abc import Mapping
from typing import Any

from tractor_ems.nodes.policy_node import PolicySetup, run_policy_node
from tractor_ems.policies.protocol import Policy
from tractor_ems.policies.registry import RULES, make_rule
from tractor_ems.policies.rules import RuleBased
from tractor_msgs_py.ros.shell import Parameter
from tractor_sim.config import load_powertrain
from tractor_sim.powertrain_json import powertrain_hash

PARAMETERS = (
    Parameter(
        "policy",
        "rule_based",
        "which rule decides",
        choices=("rule_based", *(name for name in RULES if name != "rule_based")),
    ),
    Parameter("powertrain", "paper", "powertrain, a shipped name or a YAML file"),
    Parameter("threshold_w", 110e3, "rule_based: engine when demand exceeds this", "W", 0, 1e9),
    Parameter("soc_guard", True, "rule_based: charge near the lower SOC limit"),
    Parameter(
        "guard_margin", 0.01, "rule_based: guard engages this far above SOC_min", "fraction", 0, 1
    ),
    Parameter(
        "guard_release", 0.02, "rule_based: guard releases this far above that", "fraction", 0, 1
    ),
)


def prepare(values: Mapping[str, Any]) -> PolicySetup:
    """The chosen rule for the named powertrain."""
    params = load_powertrain(values["powertrain"])
    policy: Policy
    if values["policy"] == "rule_based":
        policy = RuleBased(
            params,
            threshold_w=values["threshold_w"],
            soc_guard=values["soc_guard"],
            guard_margin=values["guard_margin"],
            guard_release=values["guard_release"],
        )
    else:
        policy = make_rule(values["policy"], params)
    return PolicySetup(policy, powertrain_hash(params), params=params)


def main() -> int:
    """Entry point."""
    return run_policy_node("rule_based_policy", PARAMETERS, prepare)


if __name__ == "__main__":
    sys.exit(main())
