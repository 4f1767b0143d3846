"""Waits for a run to say which powertrain it has, then is the node of that powertrain's policy."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node

from tractor_ems.drive_report import write_report
from tractor_ems.nodes.driving_node import DrivingNode
from tractor_msgs_py import topics
from tractor_msgs_py.codec import decode_run_info
from tractor_msgs_py.errors import BagError
from tractor_msgs_py.ros.diagnostics import PERIOD_S, diagnostic_array
from tractor_msgs_py.ros.wire import publish_on, subscribe_to


class PolicyOfRun:
    """Waits, then hands everything on. A later run of another powertrain is refused like any.

    Args:
        node: whose name it has.
        values: of the parameters.
        build: makes the policy's node of values that name a powertrain.
    """

    def __init__(
        self,
        node: Node,
        values: Mapping[str, Any],
        build: Callable[[Node, Mapping[str, Any]], DrivingNode],
    ) -> None:
        self._node, self._values, self._build = node, dict(values), build
        self._chosen: DrivingNode | None = None
        self._powertrain = ""
        self._report(ended=False)
        self._run_info = subscribe_to(node, topics.RUN_INFO, self._on_run_info)
        self._diagnostics = publish_on(node, topics.DIAGNOSTICS)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = node.create_timer(PERIOD_S, self._diagnose, clock=steady)

    def _on_run_info(self, msg: Any) -> None:
        try:
            self._powertrain = decode_run_info(msg).powertrain
        except BagError as error:
            self._node.get_logger().warning(f"refused: {error}", throttle_duration_sec=1.0)

    def _diagnose(self) -> None:
        self._diagnostics.publish(diagnostic_array(self._node, "waiting for a run", {}))

    def on_parameters(self, values: Mapping[str, Any]) -> None:
        """New values of dynamic parameters."""
        self._values.update(values)
        if self._chosen is not None:
            self._chosen.on_parameters(values)

    def finished(self) -> int | None:
        """None; the policy is chosen as soon as a run is known.

        Raises TractorEmsError where no policy ships for its powertrain.
        """
        if self._chosen is None and self._powertrain:
            chosen = self._build(self._node, {**self._values, "powertrain": self._powertrain})
            self._chosen = chosen
            self._node.destroy_subscription(self._run_info)
            self._node.destroy_timer(self._timer)
            self._node.destroy_publisher(self._diagnostics)
        return None if self._chosen is None else self._chosen.finished()

    def shutdown(self) -> None:
        """As the policy does; nothing was said before there was one."""
        if self._chosen is not None:
            self._chosen.shutdown()
        else:
            self._report(ended=True)

    def _report(self, *, ended: bool) -> None:
        """A report of an earlier drive must not look like this one's."""
        if self._values.get("report"):
            write_report(Path(self._values["report"]), {"ended": ended, "policy": ""})
