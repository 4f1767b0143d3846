"""What time it is by the stamps of a vehicle whose clock is not ours.

Stamps and receptions are compared, never the two clocks' absolute values, so a vehicle that
counts from its own start, simulated time and an old bag work alike.
"""

from dataclasses import dataclass, field

FUTURE_NS = 500_000_000
"""A stamp this far ahead of all that was seen is no delay but wrong [ns]."""

PAST_NS = 60_000_000_000
"""One this far behind is another run's, or a clock that was unset [ns]."""

CONVINCED_AFTER = 20
"""Samples that disagree with the clock until they, not it, are believed."""

WINDOW_NS = 2_000_000_000
"""The least delayed sample is forgotten after one to two of these, so that a plant that was held
up, or a clock that was set back a little, is followed. Who was silent for two of them has no say
in what time it is [ns]."""


@dataclass
class StampClock:
    """Follows stamp minus reception of the least delayed samples.

    Topics may disagree: one is wrong, or one is slow. The clock is set anew when enough samples
    of at least half of the topics are ahead of it, for a slow one may just have been heard first,
    or of most of them far behind. How often a topic speaks does not count.

    Attributes:
        scale: stamp seconds per second of reception, 1 but for accelerated replays.
        jumps: how often the clock was set anew.
    """

    scale: float = 1.0
    jumps: int = 0
    _ahead_ns: float | None = None
    _ahead_before_ns: float = 0.0
    _window_ns: int = 0
    _heard_ns: dict[str, int] = field(default_factory=dict)
    _doubts: dict[str, int] = field(default_factory=dict)

    def judge(self, stamp_ns: int, received_ns: int, topic: str = "") -> str | None:
        """``future``, ``past`` or None; a sample that is believed may set the clock."""
        self._heard_ns[topic] = received_ns
        ahead_ns = stamp_ns - self.scale * received_ns
        known_ns = self._known_ns
        if known_ns is None:
            self._set(ahead_ns, received_ns)
            return None
        reason = None
        if ahead_ns > known_ns + FUTURE_NS:
            reason = "future"
        elif ahead_ns < known_ns - PAST_NS:
            reason = "past"
        if reason is None:
            self._doubts.pop(topic, None)
            self._note(ahead_ns, received_ns)
            return None
        self._doubts[topic] = self._doubts.get(topic, 0) + 1
        if not self._convinced(reason, received_ns):
            return reason
        self.jumps += 1
        self._set(ahead_ns, received_ns)
        return None

    def _convinced(self, reason: str, received_ns: int) -> bool:
        """Enough samples in a row, of each topic's own, of enough topics disagree."""
        present = [
            topic
            for topic, heard_ns in self._heard_ns.items()
            if received_ns - heard_ns <= 2 * WINDOW_NS
        ]
        doubts = [self._doubts[topic] for topic in present if topic in self._doubts]
        against = 2 * len(doubts) - len(present)
        enough = against >= 0 if reason == "future" else against > 0
        return enough and sum(doubts) >= CONVINCED_AFTER

    def now_ns(self, received_ns: int) -> int | None:
        """Stamp time at ``received_ns`` of the local clock; None before the first sample."""
        known_ns = self._known_ns
        return None if known_ns is None else int(known_ns + self.scale * received_ns)

    @property
    def _known_ns(self) -> float | None:
        """Stamp minus reception of the least delayed sample of this window and the one before."""
        return None if self._ahead_ns is None else max(self._ahead_ns, self._ahead_before_ns)

    def _note(self, ahead_ns: float, received_ns: int) -> None:
        assert self._ahead_ns is not None
        if received_ns - self._window_ns >= WINDOW_NS:
            self._ahead_before_ns, self._ahead_ns = self._ahead_ns, ahead_ns
            self._window_ns = received_ns
        else:
            self._ahead_ns = max(self._ahead_ns, ahead_ns)

    def _set(self, ahead_ns: float, received_ns: int) -> None:
        self._ahead_ns = self._ahead_before_ns = ahead_ns
        self._window_ns = received_ns
        self._doubts.clear()
