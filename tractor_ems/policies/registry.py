"""Policies by the names people use in commands and tables."""

from pathlib import Path

from tractor_ems.policies.baselines import BASELINES, make_baseline
from tractor_ems.policies.protocol import Policy
from tractor_ems.policies.rules import BestPoint, Conventional, MyopicGreedy, RuleBased
from tractor_ems.policies.shipped import shipped_policy
from tractor_ems.scenario import Scenario
from tractor_msgs_py.errors import PolicyError
from tractor_sim.powertrain import PowertrainParams
from tractor_sim.powertrain_json import powertrain_hash

RULES = (
    "conventional",
    "rule_based",
    "best_point",
    "myopic_greedy",
    *BASELINES,
)
"""Policies that need neither training nor the future; ``a_ecms`` uses a planned end."""

NAMES = (*RULES, "dp", "default")


def policy_file(name: str, powertrain: str) -> Path:
    """The file behind ``default`` (shipped, by powertrain name) or a path.

    Raises:
        PolicyError: no policy ships for that powertrain, or the name is unknown.
    """
    if name == "default":
        return shipped_policy(powertrain)
    if not name.endswith(".safetensors"):
        raise PolicyError(
            f"policy {name!r}: unknown, names are {', '.join(NAMES)}; or give a .safetensors file"
        )
    return Path(name)


def make_rule(name: str, params: PowertrainParams) -> Policy:
    """One of :data:`RULES`; those of ``baselines`` as tuned for the powertrain, the others with
    their documented defaults.

    Raises:
        PolicyError: no such rule.
        ConfigError: a damaged file of tuned settings.
    """
    if name in BASELINES:
        return make_baseline(name, params)
    match name:
        case "conventional":
            return Conventional()
        case "rule_based":
            return RuleBased(params)
        case "best_point":
            return BestPoint(params)
        case "myopic_greedy":
            return MyopicGreedy(params)
    raise PolicyError(f"policy {name!r}: no rule, rules are {', '.join(RULES)}")


def make_policy(
    name: str,
    scenario: Scenario,
    *,
    allow_other_powertrain: bool = False,
    soc_guard: bool = True,
) -> Policy:
    """A policy ready to drive ``scenario``.

    Args:
        name: one of :data:`NAMES`, or a policy file.
        scenario: what it will drive.
        allow_other_powertrain: let a learned policy drive a powertrain it was not made for.
        soc_guard: of the rule base.

    Raises:
        PolicyError: unknown name, unreadable file, or a file made for another powertrain.
    """
    params = scenario.params
    if name == "rule_based":
        return RuleBased(params, soc_guard=soc_guard)
    if name in RULES:
        return make_rule(name, params)
    if name == "dp":
        from tractor_ems.policies.dp import solve_policy

        return solve_policy(
            params, scenario.power_demand_w, scenario.soc_initial, scenario.soc_target
        )
    from tractor_ems.policies.made import check_powertrain, load_made

    policy = load_made(policy_file(name, params.name))
    if not allow_other_powertrain:
        check_powertrain(policy, powertrain_hash(params))
    return policy


def node_of(
    policy: str,
    scenario: Scenario,
    *,
    allow_other_powertrain: bool = False,
    soc_guard: bool = True,
) -> tuple[str, dict[str, object]]:
    """Node executable and its parameters: the same choice as :func:`make_policy`."""
    if policy == "dp":
        return "dp_policy", {}
    if policy in RULES:
        return "rule_based_policy", {
            "policy": policy,
            "powertrain": scenario.powertrain_source,
            "soc_guard": soc_guard,
        }
    return "ddqn_policy", {
        "policy_file": str(policy_file(policy, scenario.params.name).resolve()),
        "allow_other_powertrain": allow_other_powertrain,
    }
