"""Counters on /diagnostics, for people; never used for control."""

from collections.abc import Mapping

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

PERIOD_S = 1.0
"""How often a node reports [s]."""


def diagnostic_array(
    node: Node, message: str, values: Mapping[str, object], *, warning: bool = False
) -> DiagnosticArray:
    """One status named after the node; ``values`` are shown as text."""
    status = DiagnosticStatus(
        level=DiagnosticStatus.WARN if warning else DiagnosticStatus.OK,
        name=node.get_fully_qualified_name(),
        hardware_id="",
        message=message,
        values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
    )
    array = DiagnosticArray(status=[status])
    array.header.stamp = node.get_clock().now().to_msg()
    return array
