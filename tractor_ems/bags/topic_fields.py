"""What any bag offers: every topic with its rate, and every number in its messages with its range.

Which of them may be which signal is guessed in ``tractor_ems.signals.candidates``.
"""

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from tractor_ems.bags.any_messages import AnyBag
from tractor_msgs_py.codec import stamp_to_ns
from tractor_msgs_py.errors import BagError
from tractor_msgs_py.trajectory import FloatArray

MAX_FIELDS = 64
"""Numbers of one topic that are looked at; images and point clouds have millions."""

MAX_DEPTH = 6
MAX_MESSAGES = 20_000
"""Messages of one topic whose numbers are looked at; all are counted."""

MAX_BYTES_OF_NAME = 64


@dataclass
class FieldRange:
    """Values of one field: count of the finite ones, least, mean, greatest; how many were not
    finite."""

    count: int = 0
    low: float = math.inf
    high: float = -math.inf
    total: float = 0.0
    not_finite: int = 0

    def add(self, value: float) -> None:
        """One more value."""
        if not math.isfinite(value):
            self.not_finite += 1
            return
        self.count += 1
        self.low, self.high = min(self.low, value), max(self.high, value)
        self.total += value

    def to_json(self) -> dict[str, Any]:
        """Plain data; a field that was never finite has no range."""
        none = not self.count
        return {
            "count": self.count,
            "min": None if none else self.low,
            "mean": None if none else self.total / self.count,
            "max": None if none else self.high,
            "not_finite": self.not_finite,
        }


@dataclass(frozen=True)
class Rhythm:
    """When messages came, by their stamps or their times of publication.

    Attributes:
        messages: how many.
        rate_hz: one over the median interval; None of fewer than two.
        jitter_s: 95 % of the intervals are no further than this from the median [s].
        largest_gap_s: longest interval [s].
    """

    messages: int
    rate_hz: float | None
    jitter_s: float | None
    largest_gap_s: float | None


def rhythm_of(stamps_ns: list[int]) -> Rhythm:
    """The rhythm of stamps in any order; repeats count as messages, not as intervals."""
    ordered_ns = np.unique(np.array(stamps_ns, dtype=np.int64))
    intervals_s: FloatArray = np.diff(ordered_ns).astype(np.float64) * 1e-9
    if not len(intervals_s):
        return Rhythm(len(stamps_ns), None, None, None)
    median_s = float(np.median(intervals_s))
    off_s = np.abs(intervals_s - median_s)
    return Rhythm(
        len(stamps_ns), 1.0 / median_s, float(np.quantile(off_s, 0.95)), float(intervals_s.max())
    )


@dataclass
class TopicFields:
    """One topic: what it is, how often it comes, and the numbers in it by field path; ``stamped``
    where its headers say a time."""

    name: str
    type: str
    unreadable: str = ""
    stamped: bool = False
    publish_ns: list[int] = field(default_factory=list)
    fields: dict[str, FieldRange] = field(default_factory=dict)

    @property
    def rhythm(self) -> Rhythm:
        """By the time of publication."""
        return rhythm_of(self.publish_ns)

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "topic": self.name,
            "type": self.type,
            "stamped": self.stamped,
            "unreadable": self.unreadable or None,
            **dataclasses.asdict(self.rhythm),
            "fields": {path: item.to_json() for path, item in self.fields.items()},
        }


def topic_fields(path: Path) -> list[TopicFields]:
    """Every topic of a bag, sorted by name.

    Raises:
        BagError: the bag is missing, cannot be read or is empty.
    """
    bag = AnyBag(path)
    found = {t.name: TopicFields(t.name, t.type) for t in bag.topics.values()}
    for name, topic in found.items():
        topic.unreadable = bag.decodable(name) or ""
    for heard in bag.messages([name for name, topic in found.items() if not topic.unreadable]):
        topic = found[heard.topic]
        topic.publish_ns.append(heard.publish_ns)
        if heard.message is None or len(topic.publish_ns) > MAX_MESSAGES:
            continue
        topic.stamped = topic.stamped or _stamped(heard.message)
        for number, (place, value) in enumerate(numbers_in(heard.message)):
            if number == MAX_FIELDS:
                break
            topic.fields.setdefault(place, FieldRange()).add(value)
    if not any(topic.publish_ns for topic in found.values()):
        raise BagError(f"{path}: holds no message that can be read")
    return [found[name] for name in sorted(found)]


def _stamped(message: Any) -> bool:
    """It says when it was true; a stamp of 0 is one that nobody has filled in."""
    try:
        return stamp_to_ns(message.header.stamp) > 0
    except (AttributeError, BagError):
        return False


def numbers_in(message: Any, prefix: str = "", depth: int = 0) -> Iterator[tuple[str, float]]:
    """Field path and value of every number in a message, its header left out.

    Entries of an array beside a ``name`` list of its length go by their names.
    """
    if depth > MAX_DEPTH or not dataclasses.is_dataclass(message):
        return
    names = _entry_names(message)
    for item in dataclasses.fields(message):
        if item.name in ("header", "__msgtype__") or item.name.startswith("_"):
            continue
        value, place = getattr(message, item.name, None), f"{prefix}{item.name}"
        if isinstance(value, bool | int | float | np.generic):
            yield place, float(value)
        elif dataclasses.is_dataclass(value):
            yield from numbers_in(value, f"{place}.", depth + 1)
        elif isinstance(value, list | np.ndarray):
            count = min(len(value), MAX_FIELDS)
            labels = names if len(names) == len(value) else [str(k) for k in range(count)]
            for label, entry in zip(labels[:count], value, strict=False):
                if isinstance(entry, bool | int | float | np.generic):
                    yield f"{place}[{label}]", float(entry)
                elif dataclasses.is_dataclass(entry):
                    yield from numbers_in(entry, f"{place}[{label}].", depth + 1)


def _entry_names(message: Any) -> list[str]:
    """Names of parallel arrays, if they are unique and can stand in a path."""
    names = [str(name) for name in getattr(message, "name", None) or ()]
    if not isinstance(getattr(message, "name", None), list | tuple):
        return []
    fit = all(n and len(n) <= MAX_BYTES_OF_NAME and "[" not in n and "]" not in n for n in names)
    fit = fit and not any(n.isdecimal() for n in names)
    return names if fit and len(set(names)) == len(names) else []
