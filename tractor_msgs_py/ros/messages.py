"""Message factory and message classes of the ROS installation."""

import math
from collections.abc import Sequence
from typing import Any

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import BatteryState, JointState
from std_msgs.msg import String

from tractor_msgs_py import topics

CLASSES: dict[str, Any] = {
    topics.JOINT_STATE: JointState,
    topics.BATTERY_STATE: BatteryState,
    topics.STRING: String,
    topics.DIAGNOSTIC_ARRAY: DiagnosticArray,
}
"""ROS type name to message class."""


def time_of(stamp_ns: int) -> Time:
    """Integer nanoseconds to builtin_interfaces/Time."""
    return Time(sec=stamp_ns // 1_000_000_000, nanosec=stamp_ns % 1_000_000_000)


class RosMessages:
    """``codec.MessageFactory`` over the ROS message classes."""

    def joint_state(
        self, stamp_ns: int, names: Sequence[str], efforts: Sequence[float]
    ) -> JointState:
        """A JointState with header stamp, names and efforts."""
        msg = JointState(name=list(names), effort=[float(value) for value in efforts])
        msg.header.stamp = time_of(stamp_ns)
        return msg

    def battery_state(
        self, stamp_ns: int, *, percentage: float, voltage: float, current: float
    ) -> BatteryState:
        """A BatteryState whose unknown numeric fields are NaN."""
        unknown = math.nan
        msg = BatteryState(
            voltage=voltage,
            current=current,
            percentage=percentage,
            temperature=unknown,
            charge=unknown,
            capacity=unknown,
            design_capacity=unknown,
            present=True,
            power_supply_technology=BatteryState.POWER_SUPPLY_TECHNOLOGY_LION,
        )
        msg.header.stamp = time_of(stamp_ns)
        return msg

    def string(self, data: str) -> String:
        """A std_msgs String."""
        return String(data=data)
