"""The optimum of one known cycle as a node: solves it at start and drives no other."""

import dataclasses
import sys
from collections.abc import Callable, Mapping
from typing import Any

from tractor_ems.nodes.policy_node import PolicySetup, run_policy_node
from tractor_ems.optimal.bracket import plan_policy
from tractor_ems.optimal.dp import solve
from tractor_ems.optimal.engine_dp import has_engine_state, solve_engine
from tractor_ems.policies.dp import DpPolicy
from tractor_msgs_py.errors import CycleError, PolicyError
from tractor_msgs_py.ros.shell import Parameter
from tractor_msgs_py.types import RunInfo
from tractor_sim.plant_run import UNSET_SOC, prepare_run

PARAMETERS = (
    Parameter("powertrain", "paper", "powertrain, a shipped name or a YAML file"),
    Parameter("cycle", "planter", "duty cycle to solve, a shipped name or a CSV file"),
    Parameter(
        "soc_initial", UNSET_SOC, "SOC at the start, -1 for the powertrain's", "fraction", -1, 1
    ),
    Parameter(
        "soc_target",
        UNSET_SOC,
        "SOC to end at, -1 for the powertrain's or where the run starts",
        "fraction",
        -1,
        1,
    ),
    # A plant with engine state has grids of its own.
    Parameter("soc_points", 401, "nodes of the SOC grid at every step", "nodes", 4, 5_000),
    Parameter("actions", 1600, "battery powers of the action grid", "actions", 2, 20_000),
)


def prepare(values: Mapping[str, Any]) -> PolicySetup:
    """Solve the named cycle; the policy refuses runs of any other."""
    run = prepare_run(
        values["powertrain"], values["cycle"], values["soc_initial"], values["soc_target"]
    )
    params, info = run.params, run.info
    if has_engine_state(params):
        plan = solve_engine(params, run.power_demand_w, info.soc_initial, info.soc_target)
        planned = dataclasses.replace(plan_policy(params, plan), t0_ns=info.t0_ns)
        return PolicySetup(planned, info.powertrain_hash, only(info), params)
    solution = solve(
        params,
        run.power_demand_w,
        info.soc_target,
        soc_initial=info.soc_initial,
        soc_points=values["soc_points"],
        actions=values["actions"],
    )
    policy = DpPolicy(params, solution, t0_ns=info.t0_ns)
    return PolicySetup(policy, info.powertrain_hash, only(info), params)


def only(solved: RunInfo) -> Callable[[RunInfo], None]:
    """A check that a run is the one that was solved."""

    def check(run: RunInfo) -> None:
        if run.cycle_hash != solved.cycle_hash:
            raise CycleError(
                f"the run drives cycle {run.cycle} ({run.cycle_hash[:12]}), solved was "
                f"{solved.cycle} ({solved.cycle_hash[:12]})"
            )
        if run.soc_target != solved.soc_target:
            raise PolicyError(
                f"the run should end at SOC {run.soc_target}, solved was {solved.soc_target}"
            )

    return check


def main() -> int:
    """Entry point."""
    return run_policy_node("dp_policy", PARAMETERS, prepare)


if __name__ == "__main__":
    sys.exit(main())
