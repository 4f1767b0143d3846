"""The plant as a ROS node: drives one duty cycle and ends. No physics and no protocol in here.

``plant_run`` is the plant, ``lockstep`` and ``real_time`` decide when it steps.
"""

import shlex
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.node import Node

from tractor_msgs_py import topics
from tractor_msgs_py.codec import decode_command, encode
from tractor_msgs_py.errors import BagError
from tractor_msgs_py.ros.diagnostics import PERIOD_S, diagnostic_array, diagnostics_publisher
from tractor_msgs_py.ros.messages import CLASSES, RosMessages
from tractor_msgs_py.ros.shell import Parameter, qos_profile, run_node
from tractor_msgs_py.types import Sample
from tractor_sim.lockstep import Lockstep, Peers
from tractor_sim.plant_run import UNSET_SOC, prepare_run
from tractor_sim.real_time import RealTime
from tractor_sim.run_files import line_of, summary, write_run

POLL_S = 0.02
ACKNOWLEDGE_S = 5.0
PARAMETERS = (
    Parameter("powertrain", "paper", "powertrain, a shipped name or a YAML file"),
    Parameter("cycle", "planter", "duty cycle, a shipped name or a CSV file"),
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
    Parameter(
        "mode",
        "lockstep",
        "wait for the answer to each tick, or step on a wall clock",
        choices=("lockstep", "real_time"),
    ),
    Parameter(
        "expected_recorders", 0, "recorders that must be connected before the start", "", 0, 16
    ),
    Parameter(
        "match_timeout_s", 0.0, "wait for a policy, 0 waits for ever", "s wall clock", 0, 86400
    ),
    Parameter(
        "answer_timeout_s", 10.0, "lockstep: wait for one answer", "s wall clock", 0.01, 3600
    ),
    Parameter("period_s", 0.0, "real time: per step, 0 for the cycle's", "s wall clock", 0, 60),
    Parameter(
        "command_timeout_s", 2.0, "real time: oldest command obeyed", "s wall clock", 0.01, 60
    ),
    Parameter("output", "", "folder for trajectory.csv and result.json, empty for none"),
)


class PlantSim:
    """Carries samples between the topics and the state machine that steps the plant."""

    def __init__(self, node: Node, values: Mapping[str, Any]) -> None:
        self._node, self._factory = node, RosMessages()
        self.run = prepare_run(
            values["powertrain"],
            values["cycle"],
            values["soc_initial"],
            values["soc_target"],
            values["mode"],
            values["expected_recorders"],
            [shlex.join(sys.argv)],
        )
        self._output = Path(values["output"]) if values["output"] else None
        self._drive: Lockstep | RealTime
        if self.run.info.lockstep:
            self._drive = Lockstep(self.run, values["answer_timeout_s"], values["match_timeout_s"])
        else:
            self._drive = RealTime(
                self.run,
                values["period_s"] or self.run.params.dt_s,
                values["command_timeout_s"],
                values["match_timeout_s"],
            )
        sent = (topics.RUN_INFO, topics.POWER_DEMAND, topics.BATTERY, topics.POWERTRAIN)
        self._publishers = {
            topic.name: node.create_publisher(
                CLASSES[topic.type], topic.name, qos_profile(topic.qos)
            )
            for topic in sent
        }
        self._commands = node.create_subscription(
            CLASSES[topics.COMMAND.type],
            topics.COMMAND.name,
            self._on_command,
            qos_profile(topics.COMMAND.qos),
        )
        self._diagnostics = diagnostics_publisher(node)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        node.create_timer(POLL_S, self._poll, clock=steady)
        node.create_timer(PERIOD_S, self._diagnose, clock=steady)
        self._publish((self.run.info,))

    def _peers(self) -> Peers:
        info, *observed = self._publishers.values()
        return Peers(
            self._commands.get_publisher_count(),
            min(publisher.get_subscription_count() for publisher in observed),
            info.get_subscription_count() > self.run.info.expected_recorders
            and info.wait_for_all_acked(Duration()),
        )

    def _publish(self, samples: tuple[Sample, ...]) -> None:
        for sample in samples:
            topic, msg = encode(sample, self._factory)
            self._publishers[topic.name].publish(msg)

    def _poll(self) -> None:
        self._publish(self._drive.poll(self._peers(), time.monotonic()))

    def _on_command(self, msg: Any) -> None:
        try:
            command = decode_command(msg)
        except BagError:
            self._drive.refusals["malformed"] += 1
            return
        publishers = self._commands.get_publisher_count()
        self._publish(self._drive.offer(command, publishers, time.monotonic()))

    def _diagnose(self) -> None:
        counters = self._drive.counters
        state = "running" if self._drive.started else "waiting for a policy"
        values = {"tick": self.run.k, "steps": self.run.info.steps, **counters}
        refused = any(count for name, count in counters.items() if name.startswith("refused"))
        self._diagnostics.publish(diagnostic_array(self._node, state, values, warning=refused))

    def finished(self) -> int | None:
        """0 once the final state has reached every subscriber and the result is written."""
        if not self._drive.done:
            return None
        deadline_s = time.monotonic() + ACKNOWLEDGE_S
        for publisher in self._publishers.values():
            publisher.wait_for_all_acked(Duration(seconds=max(deadline_s - time.monotonic(), 0.0)))
        result = summary(self.run, self._drive.counters)
        if self._output is not None:
            write_run(self._output, self.run.trajectory(), result)
        print(f"plant_sim: {line_of(result)}", flush=True)
        return 0

    def shutdown(self) -> None:
        """Nothing to make safe: the plant is simulated."""


def main() -> int:
    """Entry point."""
    return run_node("plant_sim", PARAMETERS, PlantSim)


if __name__ == "__main__":
    sys.exit(main())
