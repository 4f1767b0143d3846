"""Which numbers of a bag may be which signal, guessed by names and ranges, and a draft map.

A guess carries its reason; ``ems bag check --signals`` and a person judge it.
"""

import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

from tractor_ems.bags.topic_fields import FieldRange, TopicFields
from tractor_ems.signals.config import NAME, TYPE

WORDS = {
    "battery": r"batt(ery)?|bms|pack|accu|ess|cell",
    "engine": r"engine|genset|generator|gen|ice|diesel|motor_speed",
    "demand": r"demand|load|request(ed)?|dem|consum(er|ption|ers)?|traction|implement|drive|aux",
    "bus": r"bus|dc_?link|link|hv",
    "soc": r"soc|state_of_charge|percentage|charge_level|soc_percent",
    "power": r"power|p|kw|pwr",
    "voltage": r"voltage|volt|volts|v|u",
    "current": r"current|amp|amps|ampere|i",
    "fuel": r"fuel|fuel_rate|consumption_l_h",
    "running": r"on|running|run|engine_on|engine_running|active",
    "limit": r"limit|max|available|maximum",
    "command": r"command|cmd|setpoint|target|reference",
    "time": r"time|stamp|sec|seconds|duration",
}
DIESEL_KG_PER_L = 0.835
_CONSTANT = re.compile(r"(^|\.)([A-Z][A-Z0-9_]+|power_supply_[a-z]+)$")
"""Of message types: constants, and the codes of BatteryState."""

_PLAIN = re.compile(r"[A-Za-z/][A-Za-z0-9_./\[\]]*")
"""What YAML takes for text as it stands."""


@dataclass(frozen=True)
class Place:
    """A number in a bag: topic (full name), type, field path, range and words of its names."""

    topic: str
    type: str
    field: str
    range: FieldRange
    words: frozenset[str]

    @property
    def greatest(self) -> float:
        """Largest magnitude."""
        return max(abs(self.range.low), abs(self.range.high))


@dataclass(frozen=True)
class Candidate:
    """A guess: factors that are multiplied, times scale and sign; better ones first."""

    signal: str
    factors: tuple[Place, ...]
    scale: float
    sign: int
    score: int
    reason: str

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "signal": self.signal,
            "sources": [
                {"topic": p.topic, "type": p.type, "field": p.field} for p in self.factors
            ],
            "scale": self.scale,
            "sign": self.sign,
            "reason": self.reason,
        }


def candidates(topics: Iterable[TopicFields]) -> list[Candidate]:
    """Guesses for every signal, by signal and then the likeliest first."""
    places = [
        Place(topic.name, topic.type, path, item, _words(f"{topic.name}/{path}"))
        for topic in topics
        for path, item in topic.fields.items()
        if item.count and not _CONSTANT.search(path) and _mappable(topic, path)
    ]
    found = [*_direct(places), *_products(places)]
    order = {name: k for k, name in enumerate(dict.fromkeys(c.signal for c in found))}
    return sorted(found, key=lambda c: (order[c.signal], -c.score, c.factors[0].topic))


def _mappable(topic: TopicFields, path: str) -> bool:
    """What a map can name: foreign bags hold any text as names."""
    known = re.fullmatch(NAME, topic.name) and re.fullmatch(TYPE, topic.type)
    return bool(known) and path.isprintable()


def _words(text: str) -> frozenset[str]:
    """Kinds of words in a name: battery, power, soc ..."""
    spaced = re.sub(r"([a-z])([A-Z])", r"\1_\2", text)
    spaced = re.sub(r"BatteryState|JointState", "", spaced).lower()
    parts = re.split(r"[^a-z]+", spaced)
    runs = {"_".join(parts[a:b]) for a in range(len(parts)) for b in range(a + 1, len(parts) + 1)}
    return frozenset(
        kind for kind, pattern in WORDS.items() if any(re.fullmatch(pattern, run) for run in runs)
    )


def _direct(places: Sequence[Place]) -> Iterable[Candidate]:
    for place in places:
        words, low, high = place.words, place.range.low, place.range.high
        if "command" in words or "time" in words:
            continue
        if "soc" in words and low >= 0.0 and high <= 100.0 and "limit" not in words:
            percent = high > 1.0
            reason = "named SOC; up to 1, a fraction"
            if percent:
                reason = "named SOC; above 1, so in percent"
            yield Candidate("soc", (place,), 0.01 if percent else 1.0, 1, 3, reason)
        if "fuel" in words and "power" not in words and low >= 0.0:
            litres = high > 0.1
            reason = (
                f"named fuel; up to {high:.3g}, so L/h of Diesel, {DIESEL_KG_PER_L} kg/L"
                if litres
                else "named fuel; small, so kg/s"
            )
            scale = DIESEL_KG_PER_L / 3600.0 if litres else 1.0
            yield Candidate("fuel_kg_per_s", (place,), scale, 1, 2, reason)
        if {"engine", "running"} <= words and low >= 0.0 and high <= 1.0:
            yield Candidate("engine_on", (place,), 1.0, 1, 3, "named engine running; 0 or 1")
        if "power" in words and not words & {"limit", "soc", "fuel", "voltage", "current"}:
            yield from _power(place)


def _power(place: Place) -> Iterable[Candidate]:
    """A power in W or kW, of whatever its name says."""
    if place.greatest <= 1.0:
        return
    kilo = place.greatest < 2000.0
    unit = f"up to {place.greatest:.3g}, so in {'kW' if kilo else 'W'}"
    scale = 1000.0 if kilo else 1.0
    words = place.words
    for kind, signal in (
        ("battery", "battery_power_w"),
        ("engine", "engine_power_w"),
        ("demand", "power_demand_w"),
    ):
        if kind in words and (kind == "demand" or "demand" not in words):
            reason = f"named {kind} power; {unit}"
            if kind == "battery":
                reason += "; > 0 must be discharging, else sign: -1"
            yield Candidate(signal, (place,), scale, 1, 3, reason)


def _products(places: Sequence[Place]) -> Iterable[Candidate]:
    """Voltage times current: of one message, of topics in one folder, or the bus voltage."""
    volts = [p for p in places if "voltage" in p.words and p.greatest > 20.0]
    amps = [p for p in places if "current" in p.words and "voltage" not in p.words]
    for v, a in product(volts, amps):
        near = _near(v, a)
        if not near or {"command", "limit"} & (v.words | a.words):
            continue
        for kind, signal in (
            ("battery", "battery_power_w"),
            ("engine", "engine_power_w"),
            ("demand", "power_demand_w"),
        ):
            if kind not in a.words:
                continue
            sign, note = 1, ""
            if kind == "battery":
                sign = -1
                note = "; currents of batteries are mostly negative when discharging, else sign: 1"
            reason = f"voltage times current named {kind}{note}"
            yield Candidate(signal, (v, a), 1.0, sign, near, reason)


def _near(v: Place, a: Place) -> int:
    if v.topic == a.topic:
        return 3 if v.field.rpartition("[")[2] == a.field.rpartition("[")[2] else 1
    if v.topic.rpartition("/")[0] == a.topic.rpartition("/")[0]:
        return 2
    return 1 if "bus" in v.words else 0


def best_of(found: Sequence[Candidate]) -> dict[str, tuple[Candidate, ...]]:
    """Per signal the likeliest guess; demand that is measured in parts, the sum of the parts."""
    best: dict[str, tuple[Candidate, ...]] = {}
    for guess in found:
        known = best.get(guess.signal)
        if known is None:
            best[guess.signal] = (guess,)
        elif _another_part(guess, known):
            best[guess.signal] = (*known, guess)
    return best


def _another_part(guess: Candidate, known: Sequence[Candidate]) -> bool:
    """A second consumer: as likely a product as the first, of another current."""
    first = known[0]
    return (
        guess.signal == "power_demand_w"
        and len(guess.factors) == len(first.factors) == 2
        and guess.score == first.score
        and guess.factors[0] == first.factors[0]
        and all(guess.factors[1] != other.factors[1] for other in known)
    )


def draft(bag_name: str, found: Sequence[Candidate], topics: Sequence[TopicFields]) -> str:
    """A signal map in YAML of the likeliest guesses, the others as comments."""
    stamped = {topic.name: topic.stamped for topic in topics}
    best = best_of(found)
    name = re.sub(r"[^A-Za-z0-9_.-]", "_", bag_name)[:80] or "vehicle"
    lines = [
        f"# Draft from the bag {name}: guessed from names and ranges. Look at every line, then:",
        "# ems bag check BAG --signals THIS_FILE. The format is in config/signals.yaml.",
        f"vehicle: {json.dumps(name)}",
        "signals:",
    ]
    for signal, chosen in best.items():
        lines += [f"  {signal}:", f"    # {chosen[0].reason}"]
        if len(chosen) > 1:
            lines.append("    sum:")
            for part in chosen:
                lines += _entry(part, stamped, "      ", item=True)
        else:
            lines += _entry(chosen[0], stamped, "    ")
        others = [c for c in found if c.signal == signal and c not in chosen]
        for other in others[:5]:
            what = " * ".join(f"{p.topic} {p.field}" for p in other.factors)
            lines.append(f"    # or: {what}, scale {other.scale:.5g} ({other.reason})")
    return "\n".join(lines) + "\n"


def _entry(
    guess: Candidate, stamped: dict[str, bool], indent: str, *, item: bool = False
) -> list[str]:
    """The YAML lines of one guess."""
    lines = []
    if len(guess.factors) == 1:
        lines = _source(guess.factors[0], stamped)
    else:
        lines = ["product:"]
        for place in guess.factors:
            first, *rest = _source(place, stamped)
            lines += [f"  - {first}", *(f"    {line}" for line in rest)]
    if guess.scale != 1.0:
        lines.append(f"scale: {guess.scale:.5g}")
    if guess.sign != 1:
        lines.append(f"sign: {guess.sign}")
    if not item:
        return [indent + line for line in lines]
    return [f"{indent}- {lines[0]}", *(f"{indent}  {line}" for line in lines[1:])]


def _source(place: Place, stamped: dict[str, bool]) -> list[str]:
    return [
        f"topic: {place.topic}",
        f"type: {place.type}",
        f"field: {place.field if _PLAIN.fullmatch(place.field) else json.dumps(place.field)}",
        f"stamp: {'header' if stamped[place.topic] else 'publish'}",
    ]
