"""When a player publishes the raw messages of a bag: on a clock, or each tick after its answer.

Pure state machines: time comes in as a steady clock's seconds, messages to publish come out.
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path

from tractor_ems.bags.read import read_bag
from tractor_ems.bags.replay_topics import RawMessage
from tractor_ems.bags.rosbags_messages import header_stamp_ns
from tractor_msgs_py import topics
from tractor_msgs_py.errors import BagError, RunAborted
from tractor_msgs_py.types import BatteryPowerCommand, CommandMode

AT_ONCE = 100
"""Most messages that one poll returns, so that whoever publishes them can be stopped."""

RESEND_S = 0.2
"""An unanswered tick is published again after this long [s]."""


SINGLE_S = 1.0
"""A message of a topic without an interval is late after this long [s]."""


class Timed:
    """Recorded relative times, ``rate`` times as fast, on a schedule that is never shifted.

    Args:
        messages: in the order of their times.
        rate: > 0.
        interval_s: mean recorded interval of each topic; a message is late when it is further
            behind than that at this rate; 0 where there is none [s].

    Attributes:
        published: messages returned so far, by topic.
        late, worst_late_s: late ones, and how far behind the latest was [s].
        done: nothing is left.
    """

    def __init__(
        self, messages: Iterator[RawMessage], rate: float, interval_s: Mapping[str, float]
    ) -> None:
        self.published: Counter[str] = Counter()
        self.late, self.worst_late_s = 0, 0.0
        self._messages, self._rate, self._interval_s = messages, rate, interval_s
        self._next = next(messages, None)
        self._start_s: float | None = None

    @property
    def done(self) -> bool:
        """Nothing is left."""
        return self._next is None

    @property
    def counters(self) -> dict[str, int | float]:
        """What people want to see."""
        worst_late_ms = round(1e3 * self.worst_late_s, 1)
        return {
            "published": self.published.total(),
            "late": self.late,
            "worst_late_ms": worst_late_ms,
        }

    def wait_s(self, now_s: float) -> float:
        """Until the next message is due [s], >= 0."""
        if self._next is None or self._start_s is None:
            return 0.0
        return max(0.0, self._start_s + self._next.at_s / self._rate - now_s)

    def poll(self, now_s: float) -> list[RawMessage]:
        """What is due; the first call is when the replay begins."""
        self._start_s = now_s if self._start_s is None else self._start_s
        due: list[RawMessage] = []
        while self._next is not None and len(due) < AT_ONCE:
            behind_s = now_s - (self._start_s + self._next.at_s / self._rate)
            if behind_s < 0.0:
                break
            period_s = self._interval_s[self._next.topic] / self._rate
            self.late += behind_s > (period_s or SINGLE_S)
            self.worst_late_s = max(self.worst_late_s, behind_s)
            self.published[self._next.topic] += 1
            due.append(self._next)
            self._next = next(self._messages, None)
        return due


class Answered:
    """Each power demand only when the one before has been answered, as fast as that goes.

    Plays the plant of a recorded run to a policy. The recorded commands are not for it: leave
    them out of ``messages``.

    Args:
        messages: of a bag of this wire contract, in the order of their times.
        namespace: of its topics, ``/`` or for instance ``/tractor1``.
        timeout_s: how long an answer may take [s].

    Attributes:
        published: messages returned so far, by topic; repetitions do not count.
        resent: ticks published again.
        answered: ticks with a nominal answer.
    """

    def __init__(self, messages: Iterator[RawMessage], namespace: str, timeout_s: float) -> None:
        self.published: Counter[str] = Counter()
        self.resent, self.answered = 0, 0
        self._messages, self._timeout_s = messages, timeout_s
        base = namespace.rstrip("/")
        self._demand = f"{base}/{topics.POWER_DEMAND.name}"
        self._info = f"{base}/{topics.RUN_INFO.name}"
        self._repeated = {f"{base}/{t.name}" for t in topics.RECORDED} - {self._info}
        self._next = next(messages, None)
        self._waiting_ns: int | None = None
        self._tick_ns = 0
        self._tick: list[RawMessage] = []
        self._after: list[RawMessage] = []
        self._since_s = self._sent_s = 0.0

    @property
    def done(self) -> bool:
        """Nothing is left and the last tick is answered."""
        return self._next is None and self._waiting_ns is None

    @property
    def counters(self) -> dict[str, int | float]:
        """What people want to see."""
        return {
            "published": self.published.total(),
            "answered": self.answered,
            "resent": self.resent,
        }

    def answer(self, command: BatteryPowerCommand) -> None:
        """A command arrived; only a nominal one that echoes the present tick answers it."""
        if command.mode is CommandMode.NOMINAL and command.stamp_ns == self._waiting_ns:
            self._waiting_ns = None
            self.answered += 1

    def poll(self, now_s: float) -> list[RawMessage]:
        """What may be published now, or the unanswered tick again.

        Raises:
            RunAborted: no answer within the timeout.
        """
        due: list[RawMessage] = []
        while self._next is not None and len(due) < AT_ONCE and self._free(self._next):
            due.append(self._publish(self._next, now_s))
            self._next = next(self._messages, None)
        if due or self._waiting_ns is None:
            return due
        if now_s - self._since_s > self._timeout_s:
            raise RunAborted(
                f"no answer to {self._demand} stamped {self._waiting_ns} ns within "
                f"{self._timeout_s:g} s (tick {self.answered + 1} of the replay)"
            )
        if now_s - self._sent_s < RESEND_S:
            return []
        self.resent += 1
        self._sent_s = now_s
        return [*self._tick, *self._after]

    def _free(self, message: RawMessage) -> bool:
        """A new run or another tick waits for the answer to this one; a repetition does not."""
        if self._waiting_ns is None or message.topic not in (self._demand, self._info):
            return True
        return message.topic == self._demand and header_stamp_ns(message.data) == self._tick_ns

    def _publish(self, message: RawMessage, now_s: float) -> RawMessage:
        self.published[message.topic] += 1
        if message.topic == self._demand:
            stamp_ns = header_stamp_ns(message.data)
            if stamp_ns != self._tick_ns:
                self._tick_ns = self._waiting_ns = stamp_ns
                self._since_s = now_s
                self._tick, self._after = [*self._after, message], []
            self._sent_s = now_s
        elif message.topic in self._repeated:
            self._after.append(message)
        return message


def lockstep_run(path: Path) -> tuple[str, int]:
    """Namespace of the one tractor in a bag, and the recorders that its runs expect.

    Raises:
        BagError: the bag is not one of this wire contract, or of several tractors.
    """
    runs = read_bag(path)
    reason = "lockstep needs a recording of one tractor with run_info and battery_state"
    namespaces = sorted({run.namespace for run in runs})
    if len(namespaces) > 1:
        raise BagError(f"{path}: holds {', '.join(namespaces)}; {reason}")
    if any(run.info is None or not run.battery for run in runs):
        raise BagError(f"{path}: demand alone; {reason}")
    return namespaces[0], max(run.info.expected_recorders for run in runs if run.info)
