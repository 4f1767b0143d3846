"""Many signals at their own rates to one set of values per tick.

A frame at t_k is made of samples stamped up to t_k and of nothing else, so the order in which
topics are heard does not matter, and a live node and the reader of its bag make equal frames as
long as no sample is later than the lag. What is later is counted and serves the next tick.
"""

from bisect import bisect_right
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from math import isfinite

from tractor_msgs_py.errors import PolicyError
from tractor_msgs_py.signals import (
    SIGNALS,
    How,
    MappedSignal,
    Source,
    range_complaint,
)
from tractor_msgs_py.stamp_clock import StampClock

LAG_S = 0.02
"""How long a tick waits for samples that are on their way, unless all are there [s]."""

MAX_BUFFERED = 4096
"""Samples kept of one source: seconds of a topic that floods."""


@dataclass(frozen=True, slots=True)
class Sampling:
    """How one signal is read at a tick; ``max_age_s`` counts from the newest sample's stamp."""

    signal: str
    how: How
    max_age_s: float

    def __post_init__(self) -> None:
        if self.signal not in SIGNALS:
            raise PolicyError(f"sampling of {self.signal!r}, allowed {', '.join(SIGNALS)}")
        if self.how not in ("last", "mean"):
            raise PolicyError(f"sampling of {self.signal}: how {self.how!r}, allowed last, mean")
        if not (isfinite(self.max_age_s) and self.max_age_s > 0.0):
            raise PolicyError(
                f"sampling of {self.signal}: max_age_s {self.max_age_s}, allowed > 0"
            )


def default_sampling(name: str) -> Sampling:
    """A signal's own way."""
    return Sampling(name, SIGNALS[name].how, SIGNALS[name].max_age_s)


@dataclass(frozen=True, slots=True)
class Frame:
    """What was known at one tick.

    Attributes:
        stamp_ns: t_k.
        values: signals in SI units, those that are fresh and plausible.
        missing: the others, with the reason: ``absent``, ``stale`` or ``implausible``.
    """

    stamp_ns: int
    values: Mapping[str, float]
    missing: Mapping[str, str]


@dataclass
class _Track:
    """Samples of one source, stamps ascending."""

    stamps_ns: list[int] = field(default_factory=list)
    values: list[float] = field(default_factory=list)

    @property
    def newest_ns(self) -> int:
        return self.stamps_ns[-1] if self.stamps_ns else 0

    def at(self, stamp_ns: int) -> int:
        """Position of the newest sample up to ``stamp_ns``, -1 where there is none."""
        return bisect_right(self.stamps_ns, stamp_ns) - 1

    def forget(self, before_ns: int) -> None:
        """Drop what is not needed to know the value at ``before_ns`` or later."""
        first = max(self.at(before_ns), len(self.stamps_ns) - MAX_BUFFERED, 0)
        if first > MAX_BUFFERED // 8:
            del self.stamps_ns[:first], self.values[:first]


def _way(signal: MappedSignal, ways: Mapping[str, Sampling]) -> Sampling:
    """As the vehicle's map says, or else the policy, or else the definition."""
    way = ways.get(signal.name, default_sampling(signal.name))
    return Sampling(signal.name, signal.how or way.how, signal.max_age_s or way.max_age_s)


class Sampler:
    """Buffers the samples of one run and reads them at every tick.

    Args:
        signals: what to sample.
        sampling: per signal how, where the map does not say; the definition's way for the others.
        dt_ns, lag_ns: the period and how long a tick waits for late samples [ns].

    Attributes:
        refusals: samples by what was wrong with them.
        complaints: signal to the last text about an implausible value.
    """

    def __init__(
        self,
        signals: Sequence[MappedSignal],
        sampling: Iterable[Sampling],
        dt_ns: int,
        lag_ns: int = round(LAG_S * 1e9),
    ) -> None:
        self.refusals: Counter[str] = Counter()
        self.complaints: dict[str, str] = {}
        self.clock = StampClock()
        ways = {way.signal: way for way in sampling}
        self._signals = [(s, _way(s, ways)) for s in signals]
        self._dt_ns, self._lag_ns = dt_ns, lag_ns
        self._horizon_ns = 2 * dt_ns + round(
            1e9 * max((way.max_age_s for _, way in self._signals), default=0.0)
        )
        self._sources = tuple(dict.fromkeys(x for s, _ in self._signals for x in s.sources))
        self.start(0)

    def start(self, anchor_ns: int, scale: float = 1.0) -> None:
        """Forget everything: a new run, whose ticks are ``anchor_ns`` plus multiples of dt."""
        self.clock = StampClock(scale, self.clock.jumps)
        self._anchor_ns = anchor_ns
        self._tracks = {source: _Track() for source in self._sources}
        self._tick_ns: int | None = None

    @property
    def sources(self) -> tuple[Source, ...]:
        """What :meth:`add` takes."""
        return self._sources

    def add(self, source: Source, stamp_ns: int, value: float, received_ns: int) -> None:
        """One sample; what must not be used is refused and counted, it never raises.

        Args:
            source: where it is from, one of :attr:`sources`; others are ignored.
            stamp_ns: when it was true, by the vehicle's clock.
            value: of the source, in SI units.
            received_ns: when it was heard, by a steady local clock or the bag's log time.
        """
        track = self._tracks.get(source)
        if track is None:
            return
        reason = "zero_stamp" if stamp_ns <= 0 else None
        reason = reason or (None if isfinite(value) else "not_finite")
        if reason is None:
            jumps = self.clock.jumps
            reason = self.clock.judge(stamp_ns, received_ns, source.topic)
            if self.clock.jumps != jumps:  # the vehicle's clock was set: its past is another one
                self._tracks = {other: _Track() for other in self._sources}
                self._tick_ns, track = None, self._tracks[source]
        if reason is None and stamp_ns <= track.newest_ns:
            reason = "repeated" if stamp_ns == track.newest_ns else "out_of_order"
        if reason is not None:
            self.refusals[reason] += 1
            return
        if self._tick_ns is not None and stamp_ns <= self._tick_ns - self._dt_ns:
            self.refusals["late"] += 1  # counted, not refused: it is still the newest there is
        track.stamps_ns.append(stamp_ns)
        track.values.append(value)
        if self._tick_ns is None:
            periods = -(-(stamp_ns - self._anchor_ns) // self._dt_ns)
            self._tick_ns = self._anchor_ns + periods * self._dt_ns

    def due(self, received_ns: int) -> list[Frame]:
        """The frames of every tick that has come, oldest first."""
        frames = []
        now_ns = self.clock.now_ns(received_ns)
        while self._tick_ns is not None and now_ns is not None:
            heard_ns = min((track.newest_ns for track in self._tracks.values()), default=0)
            if max(now_ns - self._lag_ns, heard_ns) < self._tick_ns:
                break
            frames.append(self._frame(self._tick_ns))
            self._tick_ns += self._dt_ns
            self._skip_silence(now_ns)
        if frames:
            for track in self._tracks.values():
                track.forget(frames[-1].stamp_ns - self._horizon_ns)
        return frames

    def wait_ns(self, received_ns: int) -> int | None:
        """How long, by the local clock, until the next tick comes without another sample; None
        before the first sample [ns]."""
        now_ns = self.clock.now_ns(received_ns)
        if self._tick_ns is None or now_ns is None:
            return None
        return max(int((self._tick_ns + self._lag_ns - now_ns) / self.clock.scale), 0)

    def _skip_silence(self, now_ns: int) -> None:
        """Hours without any sample are one count, not an empty frame per tick."""
        assert self._tick_ns is not None
        newest_ns = max((track.newest_ns for track in self._tracks.values()), default=0)
        periods = (now_ns - self._lag_ns - self._tick_ns) // self._dt_ns
        if periods > 0 and newest_ns + self._horizon_ns < self._tick_ns:
            self.refusals["silent_ticks"] += periods
            self._tick_ns += periods * self._dt_ns

    def _frame(self, stamp_ns: int) -> Frame:
        values: dict[str, float] = {}
        missing: dict[str, str] = {}
        for signal, way in self._signals:
            positions = [self._tracks[source].at(stamp_ns) for source in signal.sources]
            if min(positions) < 0:
                missing[signal.name] = "absent"
                continue
            oldest_ns = min(
                self._tracks[source].stamps_ns[position]
                for source, position in zip(signal.sources, positions, strict=True)
            )
            if stamp_ns - oldest_ns > round(way.max_age_s * 1e9):
                missing[signal.name] = "stale"
                continue
            value = self._read(signal, stamp_ns)
            if way.how == "mean":
                value = self._mean(signal, stamp_ns, value)
            complaint = range_complaint(signal.name, value)
            if complaint is not None:
                self.complaints[signal.name] = complaint
                missing[signal.name] = "implausible"
                continue
            values[signal.name] = value
        return Frame(stamp_ns, values, missing)

    def _read(self, signal: MappedSignal, stamp_ns: int) -> float:
        """The sum of products with every source as it was known at ``stamp_ns``."""
        total = 0.0
        for term in signal.terms:
            product = 1.0
            for source in term:
                track = self._tracks[source]
                product *= track.values[track.at(stamp_ns)]
            total += product
        return total

    def _mean(self, signal: MappedSignal, stamp_ns: int, last: float) -> float:
        """Over (t_k - dt, t_k], each value held until the next; from the first known value on."""
        tracks = [self._tracks[source] for source in signal.sources]
        begin_ns = max(stamp_ns - self._dt_ns, *(track.stamps_ns[0] for track in tracks))
        if begin_ns >= stamp_ns:
            return last
        edges = {begin_ns, stamp_ns}
        for track in tracks:
            edges.update(track.stamps_ns[track.at(begin_ns) + 1 : track.at(stamp_ns) + 1])
        ordered = sorted(edges)
        area = sum(self._read(signal, a) * (b - a) for a, b in pairwise(ordered))
        return area / (stamp_ns - begin_ns)


@dataclass(frozen=True)
class EngineMemory:
    """Since when the engine is on or off, for vehicles that do not say; a start looks recent."""

    on: bool | None = None
    since_ns: int = 0
    time_in_state_s: float = 0.0

    def after(self, on: bool, stamp_ns: int) -> "EngineMemory":
        """The memory at a tick that found the engine ``on`` or off."""
        since_ns = self.since_ns if on == self.on else stamp_ns
        return EngineMemory(on, since_ns, (stamp_ns - since_ns) * 1e-9)


def engine_power_w(values: Mapping[str, float]) -> float | None:
    """Engine power at the bus: its own signal, or demand less battery power, or None [W]."""
    if "engine_power_w" in values:
        return values["engine_power_w"]
    if "power_demand_w" in values and "battery_power_w" in values:
        return values["power_demand_w"] - values["battery_power_w"]
    return None
