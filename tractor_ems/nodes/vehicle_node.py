"""A policy on a vehicle: the topics of a signal map in, decisions at every tick out.

Any publisher is heard: subscriptions are best effort, which fits every QoS a vehicle may offer.
"""

import time
from collections.abc import Callable, Sequence
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.subscription import Subscription

from tractor_ems.answer_sampled import SampledAnswerer
from tractor_ems.decide import Decision
from tractor_ems.nodes.driving_node import DrivingNode
from tractor_ems.nodes.policy_setup import Paperwork
from tractor_ems.signals.vehicle import values_of
from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.ros.wire import arrived_ns, message_class, subscribe_to, waiting
from tractor_msgs_py.signals import SignalMap, Source
from tractor_msgs_py.topics import Qos, Topic

ANY_PUBLISHER = Qos("best_effort", depth=200)
"""Deep enough for a topic that floods while the policy thinks."""

MOST_AT_ONCE = 50
"""Messages of one topic that are taken in a row before others have their turn."""

LEAST_WAIT_S, LONGEST_WAIT_S = 0.001, 0.5
"""The timer that brings ticks which no message brings is set anew for each, within these [s]."""


def by_topic(signals: SignalMap) -> dict[tuple[str, str], list[Source]]:
    """The sources of each topic and type.

    Raises:
        ConfigError: a topic is mapped with two types.
    """
    found: dict[tuple[str, str], list[Source]] = {}
    for source in signals.sources:
        found.setdefault((source.topic, source.type), []).append(source)
    names = [name for name, _ in found]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ConfigError(f"{signals.origin}: topic {twice[0]}: mapped with two types")
    return found


class VehicleNode(DrivingNode):
    """Wires one ``SampledAnswerer`` to a vehicle's topics."""

    def __init__(
        self,
        node: Node,
        answerer: SampledAnswerer,
        history_depth: int,
        papers: Paperwork | None = None,
    ) -> None:
        self._answerer, self._ticking = answerer, False
        self._heard_by: list[tuple[Subscription, Callable[[Any, Any], bool]]] = []
        super().__init__(node, answerer, history_depth, papers)

    def _listen(self) -> None:
        node, answerer = self._node, self._answerer
        for (name, type_name), sources in by_topic(answerer.signals).items():
            try:
                kind = message_class(type_name)
            except ConfigError as error:
                raise ConfigError(f"{answerer.signals.origin}: topic {name}: {error}") from None
            topic, take = Topic(name, type_name, ANY_PUBLISHER), self._taker(sources)
            receive = self._receiver(len(self._heard_by))
            subscription = subscribe_to(node, topic, receive, self.outlet.mismatch, kind)
            self._heard_by.append((subscription, take))
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._polling = node.create_timer(LONGEST_WAIT_S, self._poll, clock=steady)

    def _taker(self, sources: list[Source]) -> Callable[[Any, Any], bool]:
        """Takes a message; true where a tick came by it."""

        def take(msg: Any, info: Any) -> bool:
            arrived = arrived_ns(info, time.monotonic_ns())
            values = values_of(sources, msg, info["source_timestamp"])
            if len(values) < len(sources):
                self._answerer.refusals["malformed"] += 1
            decisions = self._answerer.sense(values, arrived, self._heard())
            self._say(decisions, arrived)
            return bool(decisions)

        return take

    def _receiver(self, number: int) -> Callable[[Any, Any], None]:
        """Takes a message and those that wait behind it."""

        def receive(msg: Any, info: Any) -> None:
            ticked = self._heard_by[number][1](msg, info)
            ticked |= self._take_waiting(number)
            if ticked or not self._ticking:
                self._ticking = self._answerer.run is not None
                self._await_tick(time.monotonic_ns())

        return receive

    def _take_waiting(self, number: int) -> bool:
        subscription, take = self._heard_by[number]
        return sum(take(msg, info) for msg, info in waiting(subscription, MOST_AT_ONCE)) > 0

    def _poll(self) -> None:
        for number in range(len(self._heard_by)):  # what has arrived is not late
            self._take_waiting(number)
        now_ns = time.monotonic_ns()
        self._say(self._answerer.poll(now_ns, self._heard()), now_ns)
        self._await_tick(now_ns)

    def _await_tick(self, now_ns: int) -> None:
        wait_ns = self._answerer.wait_ns(now_ns)
        wait_s = LONGEST_WAIT_S if wait_ns is None else wait_ns * 1e-9
        wait_s = min(max(wait_s, LEAST_WAIT_S), LONGEST_WAIT_S)
        self._polling.timer_period_ns = round(wait_s * 1e9)
        self._polling.reset()

    def _heard(self) -> bool:
        return self._answerer.decider.handover.commanding and self.outlet.listeners() > 0

    def _say(self, decisions: Sequence[Decision], since_ns: int) -> None:
        """Every decision is followed, the newest command alone is published, and none whose
        message arrived before the timeout: this process was held up since."""
        command = None
        for decision in decisions:
            command = decision.command or command
        timeout_s = self._answerer.decider.config.timeout_s
        if command is not None and time.monotonic_ns() - since_ns > timeout_s * 1e9:
            self._answerer.count.skipped += 1
            command = None
        self.outlet.say(command, since_ns)
        for decision in decisions:  # what is not urgent
            self._follow(decision)
