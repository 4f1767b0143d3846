"""The optimum driven on the real plant: what it burns there is fuel, not an interpolated value."""

import numpy as np

from tractor_ems.drive import drive
from tractor_ems.optimal.dp import DpSolution
from tractor_ems.policies.dp import DpPolicy
from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.trajectory import Trajectory
from tractor_sim.powertrain import PowertrainParams


def roll_out(
    solution: DpSolution, params: PowertrainParams, soc_initial: float | None = None
) -> Trajectory:
    """One run of the DP policy from ``soc_initial``, by default the one that was solved for.

    Raises:
        ConfigError: no initial SOC is given, neither here nor to the solution.
        PolicyError: the solution is of another powertrain.
        RunAborted: the solution does not cover ``soc_initial``.
    """
    start = solution.soc_initial if soc_initial is None else soc_initial
    if start is None:
        raise ConfigError("soc_initial: None, the solution was not made for one either")
    policy = DpPolicy(params, solution)
    return drive(
        policy, params, np.atleast_2d(solution.power_demand_w), start, solution.soc_target
    )[0]
