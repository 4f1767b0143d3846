"""The plant as a ROS node: drives one duty cycle and ends. No physics and no protocol in here.

``plant_run`` is the plant, ``lockstep`` and ``real_time`` decide when it steps, ``topic_plant``
brings it the demand of a player.
"""

import sys
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.publisher import Publisher

from tractor_msgs_py import topics
from tractor_msgs_py.codec import decode_command, encode
from tractor_msgs_py.errors import BagError
from tractor_msgs_py.ros.delivery import Delivery
from tractor_msgs_py.ros.diagnostics import PERIOD_S, diagnostic_array
from tractor_msgs_py.ros.messages import RosMessages
from tractor_msgs_py.ros.shell import run_node
from tractor_msgs_py.ros.wire import publish_on, subscribe_to
from tractor_msgs_py.types import Sample
from tractor_sim.nodes.plant_parameters import PARAMETERS, POLL_S, pace_of, poll_in_s, run_of
from tractor_sim.pace import Peers
from tractor_sim.plant_run import PlantRun
from tractor_sim.run_files import clear_run, line_of, summary, write_run

DELIVERY_S = 5.0
"""How long the end of a run is repeated to subscribers that have not acknowledged it [s]."""


class PlantSim:
    """Carries samples between the topics and the state machine that steps the plant."""

    def __init__(self, node: Node, values: Mapping[str, Any], run: PlantRun | None = None) -> None:
        self._node, self._factory = node, RosMessages()
        self._run = run_of(values) if run is None else run
        self._pace = pace_of(self._run, values)
        self._output = Path(values["output"]) if values["output"] else None
        if self._output is not None:
            clear_run(self._output)
        self._done_s: float | None = None
        self._code: int | None = None
        self._publishers = {topics.RUN_INFO.name: publish_on(node, topics.RUN_INFO)}
        for topic in (topics.POWER_DEMAND, topics.BATTERY, topics.POWERTRAIN):
            self._publishers[topic.name] = publish_on(node, topic, values["history_depth"])
        self._commands = subscribe_to(node, topics.COMMAND, self._on_command)
        self._diagnostics = publish_on(node, topics.DIAGNOSTICS)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._polling = node.create_timer(POLL_S, self.poll, clock=steady)
        node.create_timer(PERIOD_S, self._diagnose, clock=steady)
        self._publish((self._run.info,))
        self._beginning, self._end = Delivery([self._message(self._run.info)]), Delivery([])

    def _message(self, sample: Sample) -> tuple[Publisher, Any]:
        topic, msg = encode(sample, self._factory)
        return self._publishers[topic.name], msg

    def _publish(self, samples: Iterable[Sample]) -> None:
        for publisher, msg in map(self._message, samples):
            publisher.publish(msg)

    def _peers(self) -> Peers:
        counts = {n: p.get_subscription_count() for n, p in self._publishers.items()}
        announced = counts.pop(topics.RUN_INFO.name) > self._run.info.expected_recorders
        delivered = announced and self._beginning.complete(time.monotonic())
        return Peers(
            self._commands.get_publisher_count(),
            min(counts.values()),
            delivered,
            # Who has subscribed run_info must have it before any tick.
            counts[topics.POWER_DEMAND.name] if delivered or not announced else 0,
            self._run.ready,
        )

    @property
    def started(self) -> bool:
        """The first tick is out."""
        return self._pace.started

    def poll(self) -> None:
        """Do what it is time for; called on a timer, and when something was waited for."""
        now_s = time.monotonic()
        if self._done_s is not None:
            late = now_s - self._done_s > DELIVERY_S
            if late:
                self._node.get_logger().warning("a subscriber did not acknowledge the end")
            if late or self._end.complete(now_s):
                self._code = 0
        elif self._pace.started:
            self._publish(self._pace.poll(self._commands.get_publisher_count(), now_s))
        else:
            self._publish(self._pace.start(self._peers(), now_s))
        self._polling.timer_period_ns = round(1e9 * poll_in_s(self._pace, time.monotonic()))
        self._polling.reset()

    def _on_command(self, msg: Any) -> None:
        try:
            command = decode_command(msg)
        except BagError:
            self._pace.refusals["malformed"] += 1
            return
        publishers = self._commands.get_publisher_count()
        self._publish(self._pace.offer(command, publishers, time.monotonic()))

    def _diagnose(self) -> None:
        state = self._pace.state
        if self._pace.gate.missing:
            self._node.get_logger().info(state, throttle_duration_sec=30.0)
        info = self._run.info
        mode = "lockstep" if info.lockstep else "real_time"
        values = {"mode": mode, "tick": self._run.k, "steps": info.steps, **self._pace.counters}
        self._diagnostics.publish(
            diagnostic_array(self._node, state, values, warning=self._pace.refusals.total() > 0)
        )

    def _report(self) -> None:
        result = summary(self._run, self._pace.counters)
        if self._output is not None:
            write_run(self._output, self._run.trajectory(), result)
        print(f"plant_sim: {line_of(result)}", flush=True)

    def finished(self) -> int | None:
        """0 once the result is written and the end of the run has arrived everywhere."""
        if not self._pace.done or self._done_s is not None:
            return self._code
        self._report()
        self._done_s = time.monotonic()
        self._end = Delivery(map(self._message, self._run.closing_samples()))
        return None

    def shutdown(self) -> None:
        """Nothing to make safe: the plant is simulated."""


def main() -> int:
    """Entry point."""
    from tractor_sim.nodes.topic_plant import build  # which builds on this module

    return run_node("plant_sim", PARAMETERS, build)


if __name__ == "__main__":
    sys.exit(main())
