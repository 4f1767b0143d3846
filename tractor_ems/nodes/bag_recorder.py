"""Records runs into a bag that survives SIGKILL. No MCAP and no grouping of samples in here.

Ends after the asked number of complete runs, or when told to; what was received is finalised
either way. A recorder that received nothing removes what it had begun. After SIGKILL the bag
holds a part file: ``ems bag recover``.
"""

import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node

from tractor_ems.bags.progress import Progress
from tractor_ems.bags.write import BagWriter
from tractor_msgs_py import topics
from tractor_msgs_py.errors import RunAborted, TractorEmsError
from tractor_msgs_py.provenance import command_line
from tractor_msgs_py.ros.messages import CLASSES
from tractor_msgs_py.ros.shell import Parameter, qos_profile, run_node

SYNC_S = 1.0
QUEUE = 5000
"""Messages that may wait in a subscription; a depth of its own, matched with any publisher."""

PARAMETERS = (
    Parameter(
        "output",
        "",
        "folder to create for the bag; an existing one is refused; empty: named after the time",
    ),
    Parameter("runs", 1, "stop after this many complete runs, 0 for a signal", "", 0, 1_000_000),
    Parameter(
        "idle_timeout_s",
        0.0,
        "give up when nothing follows the last message for this long, 0 never",
        "s wall clock",
        0,
        86400,
    ),
)


class BagRecorder:
    """Hands raw messages to a ``BagWriter`` until ``Progress`` says that it is enough."""

    def __init__(self, node: Node, values: Mapping[str, Any]) -> None:
        self._node = node
        self._runs, self._idle_s = values["runs"], values["idle_timeout_s"]
        self._command_topic = node.resolve_topic_name(topics.COMMAND.name)
        self._commander_of = ""
        self._progress = Progress()
        self._last_s: float | None = None
        self._closed = False
        channels = {node.resolve_topic_name(topic.name): topic for topic in topics.RECORDED}
        # run_info comes first: callbacks that are ready together run in the order of creation.
        for name, topic in channels.items():
            qos = topic.qos if topic is topics.RUN_INFO else replace(topic.qos, depth=QUEUE)
            node.create_subscription(
                CLASSES[topic.type], name, self._receiver(name, topic), qos_profile(qos), raw=True
            )
        node.create_timer(SYNC_S, self._sync, clock=Clock(clock_type=ClockType.STEADY_TIME))
        provenance = {"recorder": "bag_recorder", "recorder_command_line": command_line()}
        output = values["output"] or time.strftime("tractor_ems_%Y_%m_%d-%H_%M_%S")
        self._writer = BagWriter(Path(output), channels, provenance)

    def _receiver(self, name: str, topic: topics.Topic) -> Callable[..., None]:
        def on_message(data: bytes, info: dict) -> None:
            now_s = self._last_s = time.monotonic()
            self._writer.write(
                name,
                data,
                log_time_ns=info["received_timestamp"],
                publish_time_ns=info["source_timestamp"],
                sequence=info["publication_sequence_number"] or 0,
            )
            self._progress.add(topic.name, data, now_s)
            if topic is topics.COMMAND:
                self._note_commander()

        return on_message

    def _note_commander(self) -> None:
        """Say once per run which node commands it, as soon as the graph knows."""
        run = self._progress.info
        if run is None or run.run_id == self._commander_of:
            return
        names = [
            endpoint.node_name
            for endpoint in self._node.get_publishers_info_by_topic(self._command_topic)
        ]
        if len(names) == 1 and not names[0].startswith("_"):
            self._writer.note({f"policy:{run.run_id}": names[0].removesuffix("_policy")})
            self._commander_of = run.run_id

    def _sync(self) -> None:
        if not self._closed:
            self._writer.sync()

    def finished(self) -> int | None:
        """0 once enough runs are recorded; RunAborted where nothing came for too long."""
        now_s = time.monotonic()
        self._progress.poll(now_s)
        if self._runs and self._progress.runs >= self._runs:
            self._close()
            return 0
        if self._idle_s and self._last_s is not None and now_s - self._last_s > self._idle_s:
            raise RunAborted(
                f"no message for {self._idle_s:g} s, {self._progress.runs} complete runs so far"
            )
        return None

    def _close(self) -> None:
        if self._closed:
            return
        self._closed = True
        if not self._writer.messages:
            self._writer.discard()
            print("bag_recorder: nothing was received, no bag was written", file=sys.stderr)
            return
        done = self._writer.close()
        count, runs = sum(done.messages.values()), self._progress.runs
        print(f"bag_recorder: {done.bag}: {count} messages, {runs} complete runs", flush=True)

    def shutdown(self) -> None:
        """Finalise what is there."""
        try:
            self._close()
        except TractorEmsError as error:
            print(f"bag_recorder: {error}", file=sys.stderr)
            raise SystemExit(error.exit_code) from None


def main() -> int:
    """Entry point."""
    return run_node("bag_recorder", PARAMETERS, BagRecorder)


if __name__ == "__main__":
    sys.exit(main())
