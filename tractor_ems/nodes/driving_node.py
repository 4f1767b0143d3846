"""What every policy node does beside listening: publish, watch, hand over, tell people.

``policy_node`` listens to the simulator's topics, ``vehicle_node`` to a vehicle's.
"""

import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node

from tractor_ems.decide import Decision
from tractor_ems.drive_report import Answers, line_of, state_of, values_of, warns, write_report
from tractor_ems.handover import Mode
from tractor_ems.nodes.enable_service import serve_enable
from tractor_ems.nodes.policy_setup import Paperwork, changed, soc_target_of
from tractor_ems.nodes.policy_topics import CommandOutlet
from tractor_ems.nodes.trust_log import TrustLog
from tractor_msgs_py import topics
from tractor_msgs_py.codec import decode_run_info
from tractor_msgs_py.errors import BagError, TractorEmsError
from tractor_msgs_py.ros.diagnostics import PERIOD_S, diagnostic_array
from tractor_msgs_py.ros.wire import publish_on, subscribe_to

T = TypeVar("T")
WATCH_S, WATCHES_PER_TIMEOUT = 0.05, 10.0
"""Silence is looked for this often, and this many times within its timeout."""


class DrivingNode(ABC):
    """Wires who answers to the command topic and to people.

    Attributes:
        outlet: what it publishes.
    """

    def __init__(
        self, node: Node, answers: Answers, history_depth: int, papers: Paperwork | None = None
    ) -> None:
        self._node, self._answers, self._papers = node, answers, papers or Paperwork()
        self._followed: Decision | None = None
        answers.decider.rehearse()
        self._trust_log = TrustLog(node)
        self.outlet = CommandOutlet(
            node,
            history_depth,
            driving=answers.decider.handover.commanding,
            shadow=self._papers.shadow,
        )
        # run_info comes first: callbacks that are ready together run in the order of creation.
        subscribe_to(node, topics.RUN_INFO, self._on_run_info, self.outlet.mismatch)
        self._listen()
        self._diagnostics = publish_on(node, topics.DIAGNOSTICS)
        serve_enable(node, answers.decider, self.outlet)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._watching = node.create_timer(WATCH_S, self._watch, clock=steady)
        self._pace_watch()
        node.create_timer(PERIOD_S, self._diagnose, clock=steady)

    @abstractmethod
    def _listen(self) -> None:
        """Subscribe to what the policy observes."""

    def _on_run_info(self, msg: Any) -> None:
        run = self._decoded(topics.RUN_INFO, decode_run_info, msg)
        if run is not None:
            self._answers.start_run(run)

    def _decoded(self, topic: topics.Topic, decode: Callable[[Any], T], msg: Any) -> T | None:
        """The sample, or None where it is malformed: counted and reported."""
        try:
            return decode(msg)
        except BagError as error:
            self._answers.refusals[f"malformed_{topic.name}"] += 1
            self._node.get_logger().warning(f"refused: {error}", throttle_duration_sec=1.0)
            return None

    def _follow(self, decision: Decision | None) -> None:
        """Once per decision: say the wish, log the step, leave the command topic when done."""
        if decision is None or decision is self._followed:
            return
        self._followed = decision
        self.outlet.wish(decision.wish)
        if self._papers.log is not None:
            self._papers.log.tick(decision.observation, decision.wish, decision.applied)

    def _watch(self) -> None:
        now_s, decider = time.monotonic(), self._answers.decider
        self.outlet.say(self._answers.overdue(now_s))
        if decider.mode is Mode.SHADOW:
            self.outlet.leave()
        self.outlet.tidy(now_s)
        if self._papers.log is not None:
            self._papers.log.flush(now_s)
        self._trust_log.tell(decider, getattr(self._answers, "complaints", {}))

    def _pace_watch(self) -> None:
        timeout_s = self._answers.decider.config.timeout_s
        self._watching.timer_period_ns = round(1e9 * min(WATCH_S, timeout_s / WATCHES_PER_TIMEOUT))

    def on_parameters(self, values: Mapping[str, Any]) -> None:
        """New values of dynamic parameters."""
        decider = self._answers.decider
        if "soc_target" in values:
            self._answers.aim(soc_target_of(values["soc_target"]))
        if "planned_work_s" in values:
            decider.plan_work(values["planned_work_s"])
        decider.config = changed(decider.config, values)
        self._pace_watch()

    def _values(self) -> dict[str, object]:
        outlet, log = self.outlet, self._papers.log
        return values_of(self._answers, outlet.latencies, outlet.mismatches, log, outlet.others())

    def _diagnose(self) -> None:
        values, name = self._values(), topics.COMMAND.name
        others = self.outlet.others()
        if others and self._answers.decider.handover.commanding:
            self._node.get_logger().error(
                f"{others + 1} publishers on {name}, allowed 1", throttle_duration_sec=10.0
            )
        if self._papers.log is not None and self._papers.log.trouble:
            self._node.get_logger().error(self._papers.log.trouble, once=True)
        warning = warns(self._answers, self.outlet.mismatches, self._papers.log, others)
        array = diagnostic_array(self._node, state_of(self._answers), values, warning=warning)
        self._diagnostics.publish(array)

    def finished(self) -> int | None:
        """A policy serves run after run until it is told to stop."""
        return None

    def shutdown(self) -> None:
        """Leave the safe command behind where a run is under way, then the papers."""
        self.outlet.say_last(self._answers.shutdown_command())
        name = self._node.get_name()
        try:
            if self._papers.log is not None:
                self._papers.log.close()
            if self._papers.report is not None:
                write_report(self._papers.report, {"ended": True, **self._values()})
        except TractorEmsError as error:
            print(f"{name}: {error}", file=sys.stderr)
        line = line_of(self._answers, self.outlet.latencies, self._papers.log)
        if line:
            print(f"{name}: {line}", flush=True)
