"""What a vehicle's signals mean, and from which message fields each is made.

Definitions and frozen dataclasses only: ``sampling`` reads values on a common clock, and
``tractor_ems.signals`` reads maps from YAML.
"""

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, TypeAlias

from tractor_msgs_py.errors import BagError, ConfigError

How: TypeAlias = Literal["last", "mean"]
"""``last``: the newest value at the tick. ``mean``: over the period that ends with the tick, each
value held until the next, which keeps the energy of a power."""

MAX_POWER_W = 1e9
"""A power beyond this is no tractor's [W]."""


@dataclass(frozen=True, slots=True)
class Definition:
    """One signal of the stack.

    Attributes:
        unit: SI unit, ``1`` for a fraction or a flag.
        low, high: plausible range, both included.
        how, max_age_s: how it is sampled, and the oldest value used, unless a map says so.
        meaning: what it is, for people.
    """

    unit: str
    low: float
    high: float
    how: How
    max_age_s: float
    meaning: str


SIGNALS: dict[str, Definition] = {
    "power_demand_w": Definition(
        "W", -MAX_POWER_W, MAX_POWER_W, "last", 1.5, "demand at the DC bus, auxiliaries included"
    ),
    "soc": Definition("1", 0.0, 1.0, "last", 5.0, "state of charge, a fraction"),
    "engine_on": Definition("1", 0.0, 1.0, "last", 1.5, "engine running, 0 or 1"),
    "engine_power_w": Definition(
        "W", -MAX_POWER_W, MAX_POWER_W, "last", 1.5, "power of the generator at the DC bus"
    ),
    "time_in_state_s": Definition(
        "s", 0.0, MAX_POWER_W, "last", 1.5, "how long the engine has been on, or off"
    ),
    "charge_limit_w": Definition(
        "W", 0.0, MAX_POWER_W, "last", 5.0, "most the battery can take now, >= 0"
    ),
    "discharge_limit_w": Definition(
        "W", 0.0, MAX_POWER_W, "last", 5.0, "most the battery can give now, >= 0"
    ),
    "engine_limit_w": Definition(
        "W", 0.0, MAX_POWER_W, "last", 5.0, "most the generator can give now, >= 0"
    ),
    "battery_power_w": Definition(
        "W", -MAX_POWER_W, MAX_POWER_W, "mean", 1.5, "applied battery power, > 0 discharges"
    ),
    "fuel_kg_per_s": Definition("kg/s", 0.0, 1.0, "mean", 5.0, "fuel rate"),
}
"""Every signal by name. A policy observes the first eight; learning and logs use all."""

OBSERVED = tuple(SIGNALS)[:8]
"""Signals that a policy can observe."""

VITAL = ("power_demand_w", "soc")
"""Observed signals that nothing can stand in for."""

ENGINE_ON_W = 1000.0
"""Without a signal ``engine_on`` an engine that gives more than this at the bus is on [W]."""

_PATH = re.compile(r"([A-Za-z][A-Za-z0-9_]*)((?:\[[^\[\]]+\])?)(\.|$)")


@dataclass(frozen=True, slots=True)
class Source:
    """One number in a message: ``scale * field + offset``.

    Attributes:
        topic: as the map spells it, relative names live in the node's namespace.
        type: ROS message type, ``pkg/msg/Name``.
        field: path such as ``data``, ``pose.position.x``, ``effort[2]``; in a message with a
            parallel ``name`` list, such as JointState, also ``effort[engine_on]``.
        scale, offset: to the signal's SI unit; finite, scale not 0.
        stamp: ``header`` uses the message's own stamp, ``publish`` the time it was published,
            which is all that an unstamped message has.
        per_step: the number is per step of the announced run, so its dt_s divides it.

    Raises ConfigError where a value is out of range.
    """

    topic: str
    type: str
    field: str
    scale: float = 1.0
    offset: float = 0.0
    stamp: Literal["header", "publish"] = "header"
    per_step: bool = False

    def __post_init__(self) -> None:
        parse_path(self.field)
        if not (math.isfinite(self.scale) and self.scale != 0.0):
            raise ConfigError(f"{self.topic}: scale {self.scale}, must be finite and not 0")
        if not math.isfinite(self.offset):
            raise ConfigError(f"{self.topic}: offset {self.offset}, must be finite")

    def value(self, message: Any) -> float:
        """The source's value in a message of its type. Raises BagError where it has none."""
        return self.scale * read_field(message, self.field) + self.offset


@dataclass(frozen=True, slots=True)
class MappedSignal:
    """A signal as a sum of products of sources.

    Attributes:
        name: one of :data:`SIGNALS`.
        terms: the sum's terms, each a product of at least one source.
        how, max_age_s: None: as the policy, or else the definition, says.
    """

    name: str
    terms: tuple[tuple[Source, ...], ...]
    how: How | None = None
    max_age_s: float | None = None

    def __post_init__(self) -> None:
        if self.name not in SIGNALS:
            raise ConfigError(f"signal {self.name!r}: unknown, allowed {', '.join(SIGNALS)}")
        if not self.terms or not all(self.terms):
            raise ConfigError(f"signal {self.name}: has no source")
        if self.how not in (None, "last", "mean"):
            raise ConfigError(f"signal {self.name}: how {self.how!r}, allowed last, mean")
        if self.max_age_s is not None and not 0.0 < self.max_age_s < math.inf:
            raise ConfigError(f"signal {self.name}: max_age_s {self.max_age_s}, allowed > 0")

    @property
    def sources(self) -> tuple[Source, ...]:
        """Every source once, in the order of the terms."""
        return tuple(dict.fromkeys(source for term in self.terms for source in term))


@dataclass(frozen=True)
class SignalMap:
    """Where a vehicle's signals come from.

    Attributes:
        vehicle: a name for people.
        signals: each name at most once.
        soc_target: SOC a run should end at where no run_info says so; None: the powertrain's.
        p_aux_w: auxiliary power contained in power_demand_w where no run_info says so [W].
        origin: file it was read from, for messages.
    """

    vehicle: str
    signals: tuple[MappedSignal, ...]
    soc_target: float | None = None
    p_aux_w: float = 0.0
    origin: str = ""

    def __post_init__(self) -> None:
        names = [signal.name for signal in self.signals]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ConfigError(f"signal {twice[0]}: mapped twice")
        if self.soc_target is not None and not 0.0 <= self.soc_target <= 1.0:
            raise ConfigError(f"soc_target: {self.soc_target}, allowed 0..1")
        if not 0.0 <= self.p_aux_w <= MAX_POWER_W:
            raise ConfigError(f"p_aux_w: {self.p_aux_w}, allowed 0..{MAX_POWER_W:g}")

    @property
    def names(self) -> tuple[str, ...]:
        """Signals that are mapped."""
        return tuple(signal.name for signal in self.signals)

    @property
    def sources(self) -> tuple[Source, ...]:
        """Every source once."""
        return tuple(dict.fromkeys(s for signal in self.signals for s in signal.sources))

    def of(self, names: Iterable[str]) -> tuple[MappedSignal, ...]:
        """The mapped signals among ``names``."""
        wanted = set(names)
        return tuple(signal for signal in self.signals if signal.name in wanted)


def range_complaint(name: str, value: float) -> str | None:
    """Why a signal's value cannot be right, naming signal, value and allowed range; or None."""
    definition = SIGNALS[name]
    if not math.isfinite(value):
        return f"{name}: {value}, must be finite"
    if definition.low <= value <= definition.high:
        return None
    text = f"{name}: {value:g}, allowed {definition.low:g}..{definition.high:g}"
    if name == "soc" and 1.0 < value <= 100.0:
        text += "; looks like percent, which needs scale: 0.01 in the signal map"
    return text


@lru_cache(maxsize=1024)
def parse_path(path: str) -> tuple[tuple[str, str], ...]:
    """A field path as (attribute, index) pairs, the index empty where there is none.

    Raises:
        ConfigError: it is no field path.
    """
    parts: list[tuple[str, str]] = []
    position = 0
    while position < len(path):
        match = _PATH.match(path, position)
        if match is None or (match.end() == len(path) and match.group(3) == "."):
            break
        parts.append((match.group(1), match.group(2)[1:-1]))
        position = match.end()
    if not parts or position != len(path):
        raise ConfigError(
            f"field {path!r}: expected a path such as data, pose.position.x, effort[2] or "
            "effort[engine_on]"
        )
    return tuple(parts)


def read_field(message: Any, path: str) -> float:
    """The number at ``path`` in a message of rclpy or of ``rosbags``; flags count as 0 and 1.

    Raises:
        BagError: there is no such field or entry, or it is no number.
    """
    value = message
    for name, index in parse_path(path):
        owner = value
        value = getattr(owner, name, None)
        if value is None:
            raise BagError(f"field {path}: no {name} in {type(owner).__name__}")
        if index:
            value = _entry(owner, value, index, path)
    if isinstance(value, str | bytes) or hasattr(value, "__len__"):
        raise BagError(f"field {path}: {type(value).__name__} is no number, give an index")
    try:
        return float(value)
    except (TypeError, ValueError):
        raise BagError(f"field {path}: {type(value).__name__} is no number") from None


def _entry(owner: Any, values: Any, index: str, path: str) -> Any:
    if index.isdecimal():
        position = int(index)
    else:
        names = [str(name) for name in getattr(owner, "name", ())]
        if index not in names:
            raise BagError(f"field {path}: no entry named {index}, there are {names}")
        position = names.index(index)
    try:
        return values[position]
    except (IndexError, TypeError, KeyError):
        raise BagError(f"field {path}: no entry {position}") from None
