"""The last word before a command is published: projection and the fallback law. Pure.

The plant checks again on its side; neither trusts the other.
"""

import math

import numpy as np

from tractor_ems.policies.protocol import limits_of
from tractor_msgs_py.observation import Observation
from tractor_msgs_py.types import BatteryPowerCommand, CommandMode
from tractor_sim.powertrain import Command, feasible_battery_power_w, project

TOLERANCE_W = 1e-3
"""A command moved by less than this counts as untouched [W]."""


def safe(observation: Observation, command: Command) -> Command:
    """The commands of a batch, projected on the published limits.

    Battery power that is not finite becomes the fallback law's, engine power that is infinite
    becomes "no opinion".
    """
    lb, ub = feasible_battery_power_w(limits_of(observation), observation.power_demand_w)
    engine_w = command.engine_power_w
    return Command(
        project(command.battery_power_w, lb, ub), np.where(np.isinf(engine_w), np.nan, engine_w)
    )


def safe_command(observation: Observation, command: Command) -> tuple[BatteryPowerCommand, bool]:
    """The policy's command for a batch of one, made safe.

    Returns:
        The nominal command, and whether it had to be corrected.
    """
    made = safe(observation, command)
    battery_w, engine_w = float(made.battery_power_w[0]), float(made.engine_power_w[0])
    moved_w = abs(battery_w - float(command.battery_power_w[0]))
    corrected = math.isinf(command.engine_power_w[0]) or not moved_w <= TOLERANCE_W
    return BatteryPowerCommand(observation.stamp_ns, battery_w, engine_w), corrected


def fallback_command(observation: Observation, mode: CommandMode) -> BatteryPowerCommand:
    """The fallback law: zero battery power projected on the feasible set, clip(0, lb, ub)."""
    lb, ub = feasible_battery_power_w(limits_of(observation), observation.power_demand_w)
    zero_w = project(observation.power_demand_w[:1] * 0.0, lb[:1], ub[:1])
    return BatteryPowerCommand(observation.stamp_ns, float(zero_w[0]), mode=mode)
