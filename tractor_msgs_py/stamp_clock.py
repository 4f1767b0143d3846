"""What time it is by the stamps of a vehicle whose clock is not ours.

Stamps and receptions are compared, never the two clocks' absolute values, so a vehicle that
counts from its own start, simulated time and an old bag work alike.
"""

from dataclasses import dataclass

FUTURE_NS = 500_000_000
"""A stamp this far ahead of all that was seen is no delay but wrong [ns]."""

PAST_NS = 60_000_000_000
"""One this far behind is another run's, or a clock that was unset [ns]."""

CONVINCED_AFTER = 20
"""Samples in a row that disagree with the clock until they, not it, are believed."""

DRIFT = 5e-3
"""How fast the clocks may drift apart. Quartz is far better; a plant that was held up for 0.1 s and
does not catch up is followed within 20 s, and between samples 0.1 s apart this is 0.5 ms."""


@dataclass
class StampClock:
    """Follows stamp minus reception of the least delayed samples.

    Attributes:
        scale: stamp seconds per second of reception, 1 but for accelerated replays.
        jumps: how often the clock was set anew.
    """

    scale: float = 1.0
    jumps: int = 0
    _ahead_ns: float | None = None
    _at_ns: int = 0
    _doubts: int = 0

    def judge(self, stamp_ns: int, received_ns: int) -> str | None:
        """``future``, ``past`` or None; a sample that is believed may set the clock."""
        ahead_ns = stamp_ns - self.scale * received_ns
        known_ns = self._ahead_now_ns(received_ns)
        if known_ns is None:
            self._set(ahead_ns, received_ns)
            return None
        reason = None
        if ahead_ns > known_ns + FUTURE_NS:
            reason = "future"
        elif ahead_ns < known_ns - PAST_NS:
            reason = "past"
        if reason is None:
            self._doubts = 0
            if ahead_ns >= known_ns:
                self._set(ahead_ns, received_ns)
            return None
        self._doubts += 1
        if self._doubts < CONVINCED_AFTER:
            return reason
        self.jumps += 1
        self._set(ahead_ns, received_ns)
        return None

    def now_ns(self, received_ns: int) -> int | None:
        """Stamp time at ``received_ns`` of the local clock; None before the first sample."""
        known_ns = self._ahead_now_ns(received_ns)
        return None if known_ns is None else int(known_ns + self.scale * received_ns)

    def _ahead_now_ns(self, received_ns: int) -> float | None:
        if self._ahead_ns is None:
            return None
        return self._ahead_ns - DRIFT * self.scale * max(received_ns - self._at_ns, 0)

    def _set(self, ahead_ns: float, received_ns: int) -> None:
        self._ahead_ns, self._at_ns, self._doubts = ahead_ns, received_ns, 0
