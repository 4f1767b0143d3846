"""What flows between the nodes: topic names, message types and QoS, in one table.

Names are relative, so the namespace is the user's (``-r __ns:=/tractor1``). Nothing here imports
ROS; ``tractor_msgs_py.ros.shell`` turns a :class:`Qos` into an rclpy profile.
"""

from dataclasses import dataclass
from typing import Literal

JOINT_STATE = "sensor_msgs/msg/JointState"
BATTERY_STATE = "sensor_msgs/msg/BatteryState"
STRING = "std_msgs/msg/String"
DIAGNOSTIC_ARRAY = "diagnostic_msgs/msg/DiagnosticArray"


@dataclass(frozen=True, slots=True)
class Qos:
    """Quality of service of a topic. No deadline is ever requested: a subscription that asks for
    one refuses every publisher that offers none."""

    reliability: Literal["reliable", "best_effort"] = "reliable"
    durability: Literal["volatile", "transient_local"] = "volatile"
    depth: int = 10


@dataclass(frozen=True, slots=True)
class Topic:
    """One row of the wire contract: relative name, ROS message type, QoS."""

    name: str
    type: str
    qos: Qos = Qos()


POWER_DEMAND = Topic("power_demand", JOINT_STATE)
BATTERY = Topic("battery_state", BATTERY_STATE)
POWERTRAIN = Topic("powertrain_state", JOINT_STATE)
COMMAND = Topic("battery_power_command", JOINT_STATE)
DUTY_CYCLE_DEMAND = Topic("duty_cycle_demand", JOINT_STATE)
DUTY_CYCLE_INFO = Topic("duty_cycle_info", STRING, Qos(durability="transient_local", depth=1))
RUN_INFO = Topic("run_info", STRING, Qos(durability="transient_local", depth=1))
DIAGNOSTICS = Topic("/diagnostics", DIAGNOSTIC_ARRAY)

RECORDED: tuple[Topic, ...] = (RUN_INFO, POWER_DEMAND, BATTERY, POWERTRAIN, COMMAND)
"""What a recording holds, and what a reader may rely on."""
