"""The upper end of the bracket: a run of the real plant, ramp limit and minimum times kept."""

from tractor_ems.drive import drive
from tractor_ems.optimal.engine_dp import EngineSolution
from tractor_ems.policies.planned import PlannedPolicy
from tractor_msgs_py.trajectory import Trajectory
from tractor_sim.powertrain import PowertrainParams


def plan_policy(params: PowertrainParams, solution: EngineSolution) -> PlannedPolicy:
    """The optimum as the real plant can drive it."""
    plan = solution.plan
    return PlannedPolicy(params, solution.power_demand_w, plan.engine_power_w, plan.engine_on)


def drive_plan(params: PowertrainParams, solution: EngineSolution) -> Trajectory:
    """That run, driven."""
    soc = float(solution.plan.soc[0])
    target = soc if solution.soc_target is None else solution.soc_target
    policy = plan_policy(params, solution)
    return drive(policy, params, solution.power_demand_w[None, :], soc, target)[0]
