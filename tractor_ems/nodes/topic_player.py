"""Publishes the topics of a bag raw: recorded bytes, QoS and times. No protocol in here.

``bags.replay_topics`` reads them, ``bags.replay_schedule`` decides when they are published.
"""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.node import Node

from tractor_ems.bags.replay_schedule import Answered, Timed, lockstep_run
from tractor_ems.bags.replay_topics import Choice, messages_of, recorded_topics
from tractor_ems.nodes.raw_publishers import raw_publishers
from tractor_msgs_py import topics
from tractor_msgs_py.codec import decode_command
from tractor_msgs_py.errors import BagError, ConfigError, RunAborted
from tractor_msgs_py.ros.diagnostics import PERIOD_S, diagnostic_array
from tractor_msgs_py.ros.wire import publish_on, subscribe_to

SETTLE_S = 0.5
"""From the first subscriber to the first message: the others' time to be found [s]."""

DELIVERY_S = 5.0
"""How long the end waits for subscribers to acknowledge what was published [s]."""

SHORTEST_POLL_S, LONGEST_POLL_S = 0.0005, 0.02


class TopicPlayer:
    """Carries raw messages from a bag to publishers of the same name, type and QoS."""

    def __init__(self, node: Node, values: Mapping[str, Any]) -> None:
        self._node, path = node, Path(values["bag"])
        named, without = ([n for n in values[key] if n] for key in ("topics", "exclude"))
        choice = Choice(named, without, values["start_s"], values["duration_s"])
        found = recorded_topics(path, choice)
        lockstep = values["pace"] == "lockstep"
        namespace, recorders = lockstep_run(path) if lockstep else ("", 0)
        demand = f"{namespace.rstrip('/')}/{topics.POWER_DEMAND.name}"
        command = f"{namespace.rstrip('/')}/{topics.COMMAND.name}"
        found = [topic for topic in found if not lockstep or topic.name != command]
        self._publishers, self._skipped = raw_publishers(node, found)
        if not self._publishers:
            raise ConfigError(
                f"{path}: nothing that ROS here can publish: {', '.join(self._skipped)}"
            )
        if lockstep and demand not in self._publishers:
            raise ConfigError(f"parameters topics, exclude: lockstep needs {demand}")
        messages = messages_of(path, choice, list(self._publishers))
        self._schedule: Timed | Answered
        if lockstep:
            self._schedule = Answered(messages, namespace, values["answer_timeout_s"])
            # The recorders that the run announced are not here: the player stands in for them.
            row = topics.Topic(command.lstrip("/"), topics.COMMAND.type, topics.COMMAND.qos)
            for _ in range(1 + recorders):
                self._commands = subscribe_to(node, row, self._on_command)
        else:
            intervals = {topic.name: topic.interval_s for topic in found}
            self._schedule = Timed(messages, values["rate"], intervals)
        self._match_s, self._since_s = values["match_timeout_s"], time.monotonic()
        self._first_s: float | None = None
        self._done_s: float | None = None
        self._unheard = 0
        self._diagnostics = publish_on(node, topics.DIAGNOSTICS)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = node.create_timer(LONGEST_POLL_S, self._poll, clock=steady)
        node.create_timer(PERIOD_S, self._diagnose, clock=steady)

    def _poll(self) -> None:
        now_s = time.monotonic()
        if not self._matched(now_s) or self._done_s is not None:
            return
        for message in self._schedule.poll(now_s):
            publisher = self._publishers[message.topic]
            self._unheard += publisher.get_subscription_count() == 0
            publisher.publish(message.data)
        if self._schedule.done:
            self._done_s = now_s
        if isinstance(self._schedule, Timed):
            wait_s = self._schedule.wait_s(time.monotonic())
            wait_s = min(max(wait_s, SHORTEST_POLL_S), LONGEST_POLL_S)
            self._timer.timer_period_ns = round(wait_s * 1e9)
            self._timer.reset()

    def _matched(self, now_s: float) -> bool:
        """Somebody listens, in lockstep somebody answers too, and the rest had time to come."""
        if self._first_s is None:
            waited_s = now_s - self._since_s
            heard = any(p.get_subscription_count() for p in self._publishers.values())
            answered = isinstance(self._schedule, Timed) or self._commands.get_publisher_count()
            if heard and answered:
                self._first_s = now_s
            elif 0.0 < self._match_s < waited_s:
                who = "subscriber" if not heard else f"publisher on {topics.COMMAND.name}"
                raise RunAborted(f"no {who} within {self._match_s:g} s")
        return self._first_s is not None and now_s - self._first_s >= SETTLE_S

    def _on_command(self, msg: Any) -> None:
        if not isinstance(self._schedule, Answered):
            return
        publishers = self._commands.get_publisher_count()
        if publishers > 1 and not self._schedule.done:
            raise RunAborted(f"{publishers} publishers on {topics.COMMAND.name}, allowed 1")
        try:
            self._schedule.answer(decode_command(msg))
        except BagError as error:
            self._node.get_logger().warning(f"refused: {error}", throttle_duration_sec=1.0)
        else:
            self._poll()

    def _counters(self) -> dict[str, object]:
        return {
            **self._schedule.counters,
            "topics": len(self._publishers),
            "without_subscriber": self._unheard,
            "skipped": ", ".join(self._skipped) or "none",
        }

    def _diagnose(self) -> None:
        state = "playing" if self._first_s is not None else "waiting for a subscriber"
        bad = bool(self._skipped or self._schedule.counters.get("late"))
        self._diagnostics.publish(
            diagnostic_array(self._node, state, self._counters(), warning=bad)
        )

    def finished(self) -> int | None:
        """0 once everything is published and acknowledged, or was not within a few seconds."""
        if self._done_s is None:
            return None
        acknowledged = all(p.wait_for_all_acked(Duration()) for p in self._publishers.values())
        if not acknowledged and time.monotonic() - self._done_s < DELIVERY_S:
            return None
        if not acknowledged:
            self._node.get_logger().warning("a subscriber did not acknowledge the end")
        return 0

    def shutdown(self) -> None:
        """Say what was played."""
        shown = ", ".join(f"{name} {value}" for name, value in self._counters().items())
        print(f"bag_player: {shown}", flush=True)
