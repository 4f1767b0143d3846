"""How far a recording has come: which runs it has seen to their end. Pure; used by the recorder.

A run is over when the last sample of each of its topics is there: the final state, the last
demand and, in lockstep, the last answer, which travels on its own and may come after the state.
"""

from tractor_ems.bags.read import decode
from tractor_ems.bags.rosbags_messages import header_stamp_ns
from tractor_msgs_py import topics
from tractor_msgs_py.errors import BagError
from tractor_msgs_py.types import RunInfo

LATE_S = 2.0
"""How long the rest of a run may come after its final state [s]; then it is lost."""


class Progress:
    """Counts the runs that were recorded to their end.

    Attributes:
        info: the run under way; None before the first.
        runs: runs that are over.
    """

    def __init__(self) -> None:
        self.info: RunInfo | None = None
        self.runs = 0
        self._latest_ns: dict[str, int] = {}
        self._over = False
        self._final_since_s: float | None = None

    def add(self, name: str, data: bytes, now_s: float) -> None:
        """A message of the contract topic ``name`` arrived; malformed ones are ignored here."""
        try:
            if name == topics.RUN_INFO.name:
                self._start(data)
                return
            self._latest_ns[name] = header_stamp_ns(data)
        except BagError:
            return
        self._judge(now_s)

    def poll(self, now_s: float) -> None:
        """Time passes: a run whose final state is there does not wait for the rest for ever."""
        if self._final_since_s is not None and now_s - self._final_since_s > LATE_S:
            self._end()

    def _start(self, data: bytes) -> None:
        info = decode(topics.RUN_INFO.name, data)
        if not isinstance(info, RunInfo):
            return
        if self.info is not None and self.info.run_id != info.run_id:
            self._latest_ns = {}  # the next run may have the same stamps
            self._over, self._final_since_s = False, None
        self.info = info

    def _judge(self, now_s: float) -> None:
        info = self.info
        if info is None or self._over:
            return
        last_ns, end_ns = info.stamp_ns(info.steps - 1), info.stamp_ns(info.steps)
        if self._reached(topics.BATTERY, end_ns) and self._reached(topics.POWERTRAIN, end_ns):
            if self._final_since_s is None:
                self._final_since_s = now_s
            answered = self._reached(topics.COMMAND, last_ns) or not info.lockstep
            if answered and self._reached(topics.POWER_DEMAND, last_ns):
                self._end()

    def _reached(self, topic: topics.Topic, stamp_ns: int) -> bool:
        return self._latest_ns.get(topic.name, 0) >= stamp_ns

    def _end(self) -> None:
        self.runs += 1
        self._over, self._final_since_s = True, None
