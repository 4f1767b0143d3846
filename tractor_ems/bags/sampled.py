"""Bags of any vehicle through its signal map: what a live node would have sampled, tick by tick.

Messages go through the live node's ObservationBuilder in the order of their recording, so frames
and observations are the live ones. Traces to learn from are made in ``sampled_traces``.
"""

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tractor_ems.bags.any_messages import AnyBag, Heard
from tractor_ems.bags.read import bag_hash, provenance_of
from tractor_ems.signals.vehicle import reception_ns, values_of, vehicle_run
from tractor_msgs_py import topics
from tractor_msgs_py.codec import decode_run_info
from tractor_msgs_py.errors import BagError, ConfigError
from tractor_msgs_py.observation import ObservationBuilder, ObservationSpec, SampledTick
from tractor_msgs_py.signals import SignalMap, Source
from tractor_msgs_py.trajectory import FloatArray, IntArray
from tractor_msgs_py.types import RunInfo

NEEDED = ("power_demand_w",)
"""Signals without which a bag is of no use here."""

END_NS = 1_000_000
"""Time past the last message and the lag until which ticks are taken, for clocks that drift."""

TICKS = ("absent_", "stale_", "implausible_", "silent_ticks", "late")
"""Counts of the builder that are about ticks or order; the others are samples not used."""


@dataclass(frozen=True)
class SampledRun:
    """One run: what was announced, or made up where nothing was, and every tick of it."""

    info: RunInfo
    announced: bool
    ticks: tuple[SampledTick, ...]


@dataclass(frozen=True)
class SampledBag:
    """A bag as a node with this signal map and spec would have sampled it.

    Attributes:
        path, sha256: of the bag.
        namespace: in which the map's relative topics are.
        absent: mapped signals that the bag has no topic for.
        runs: in the order of their start.
        refusals: samples and ticks that were not used, by reason.
        complaints: signal to the last text about an implausible value.
        provenance: what the bag's writer said, if anything.
    """

    path: Path
    sha256: str
    namespace: str
    absent: tuple[str, ...]
    runs: tuple[SampledRun, ...]
    refusals: Mapping[str, int]
    complaints: Mapping[str, str]
    provenance: Mapping[str, str]

    @property
    def refused_samples(self) -> int:
        """Samples that were not used."""
        return sum(self.refused_by_reason.values())

    @property
    def refused_by_reason(self) -> dict[str, int]:
        """The same by reason."""
        return {r: n for r, n in self.refusals.items() if not r.startswith(TICKS)}


@dataclass(frozen=True)
class Wiring:
    """Where a map's sources are in one bag.

    Attributes:
        namespace: of the relative topics.
        sources: full topic name to its sources; topics that the bag does not have are left out.
        absent: signal to the topics that the bag does not have for it.
        run_info: full name of the topic on which runs are announced, empty where there is none.
    """

    namespace: str
    sources: Mapping[str, tuple[Source, ...]]
    absent: Mapping[str, tuple[str, ...]]
    run_info: str = ""


def full_name(namespace: str, topic: str) -> str:
    """A topic of the map in a namespace, ``/`` or for instance ``/tractor1``."""
    return topic if topic.startswith("/") else f"{namespace.rstrip('/')}/{topic}"


def wire(
    bag: AnyBag, signals: SignalMap, namespace: str | None = None, needed: Iterable[str] = NEEDED
) -> Wiring:
    """Find a map's topics in a bag.

    Args:
        bag: any.
        signals: the map.
        namespace: of its relative topics; None: the only one in which the needed signals are.
        needed: signals whose topics must be there.

    Raises:
        BagError: a needed signal is not mapped or its topic not there, a topic has another type,
            or several namespaces fit.
    """
    held = bag.topics
    for name in needed:
        if name not in signals.names:
            raise BagError(
                f"{bag.path}: needs signal {name}, {signals.origin or 'the signal map'} maps "
                f"{', '.join(signals.names)}"
            )
    wanted = [source for signal in signals.of(needed) for source in signal.sources]
    if namespace is None:
        namespace = _namespace(bag, wanted)
    namespace = f"/{namespace.strip('/')}"
    _expect(bag, namespace, wanted)
    wiring: dict[str, tuple[Source, ...]] = {}
    absent: dict[str, tuple[str, ...]] = {}
    for signal in signals.signals:
        names = [full_name(namespace, source.topic) for source in signal.sources]
        missing = tuple(dict.fromkeys(name for name in names if name not in held))
        if missing:
            absent[signal.name] = missing
    for source in signals.sources:
        name = full_name(namespace, source.topic)
        if name not in held:
            continue
        if held[name].type != source.type:
            raise BagError(
                f"{bag.path}: {name} is {held[name].type}, the signal map expects {source.type}"
            )
        wiring[name] = (*wiring.get(name, ()), source)
    announced = full_name(namespace, topics.RUN_INFO.name)
    there = announced in held and held[announced].type == topics.RUN_INFO.type
    return Wiring(namespace, wiring, absent, announced if there else "")


def _namespace(bag: AnyBag, wanted: list[Source]) -> str:
    """The only namespace with all the wanted topics; or that with the most, to say there what is
    missing."""
    relative = {source.topic for source in wanted if not source.topic.startswith("/")}
    counts = Counter(
        name.removesuffix(topic)
        for topic in relative
        for name in bag.topics
        if name.endswith("/" + topic)
    )
    fits = sorted(begin for begin, count in counts.items() if count == len(relative))
    if len(fits) > 1:
        names = ", ".join(begin.rstrip("/") or "/" for begin in fits)
        raise BagError(f"{bag.path}: {min(relative)} is in the namespaces {names}, choose one")
    best = max(sorted(counts), key=lambda begin: counts[begin], default="/")
    return best.rstrip("/") or "/"


def _expect(bag: AnyBag, namespace: str, wanted: list[Source]) -> None:
    held = bag.topics
    for source in wanted:
        name = full_name(namespace, source.topic)
        if name not in held:
            found = ", ".join(sorted(f"{t.name} ({t.type})" for t in held.values()))
            raise BagError(f"{bag.path}: no topic {name} ({source.type}), holds {found}")


def read_sampled(
    path: Path,
    signals: SignalMap,
    spec: ObservationSpec,
    *,
    namespace: str | None = None,
    soc_target: float | None = None,
) -> SampledBag:
    """Sample a bag every ``spec.dt_s``.

    Args:
        path: bag folder or storage file.
        signals: where the signals are.
        spec: of mode ``sampled``.
        namespace: see :func:`wire`.
        soc_target: where neither the bag nor the map says it; None: 0.5, which only observations
            show.

    Raises:
        BagError: the bag cannot be read or does not fit the map.
        PolicyError: the map supplies less than the spec needs.
    """
    bag = AnyBag(path)
    wiring = wire(bag, signals, namespace)
    builder = ObservationBuilder(spec, signals)
    runs: list[tuple[RunInfo, bool, list[SampledTick]]] = []

    def start(info: RunInfo, announced: bool) -> None:
        known = builder.run
        builder.start_run(info)
        if builder.run is not known:
            runs.append((info, announced, []))

    first = next(_announced(bag, wiring), None)
    if first is None:
        assert spec.dt_s is not None
        target = signals.soc_target if signals.soc_target is not None else soc_target
        start(vehicle_run(spec.dt_s, 0.5 if target is None else target), False)
    else:  # announced on a topic of its own, so its first samples may have been heard before
        start(first, True)
    received_ns = 0
    names = {*wiring.sources, *([wiring.run_info] if wiring.run_info else [])}
    for heard in bag.messages(names):
        if heard.message is None:
            builder.refusals["unreadable"] += 1
        elif heard.topic == wiring.run_info:
            begun = len(runs)
            start(_run_info(bag, heard), True)
            received_ns = received_ns if len(runs) == begun else 0
        else:
            info, _, ticks = runs[-1]
            sources = wiring.sources[heard.topic]
            for source, stamp_ns, value in values_of(sources, heard.message, heard.publish_ns):
                received_ns = reception_ns(info, stamp_ns, heard.log_ns, received_ns)
                ticks += builder.sense(source, stamp_ns, value, received_ns)
    runs[-1][2].extend(builder.poll(received_ns + round(spec.lag_s * 1e9) + END_NS))
    return SampledBag(
        path=path,
        sha256=bag_hash(path),
        namespace=wiring.namespace,
        absent=tuple(wiring.absent),
        runs=tuple(SampledRun(info, known, tuple(ticks)) for info, known, ticks in runs),
        refusals=dict(builder.refusals),
        complaints=dict(builder.complaints),
        provenance=provenance_of(path),
    )


def _announced(bag: AnyBag, wiring: Wiring) -> Iterator[RunInfo]:
    if wiring.run_info:
        for heard in bag.messages([wiring.run_info]):
            if heard.message is not None:
                yield _run_info(bag, heard)


def _run_info(bag: AnyBag, heard: Heard) -> RunInfo:
    try:
        return decode_run_info(heard.message)
    except BagError as error:
        raise BagError(f"{bag.path}: {heard.topic}: {error}") from None


@dataclass(frozen=True)
class Series:
    """Every value of one signal as it was recorded, shape (N,), in the order of recording.

    Attributes:
        stamp_ns, value: of each new value of the signal's source with the most messages, with the
            others as they were known by then.
        info: the run that was announced; None where none was, or several were.
        runs: announced runs.
    """

    stamp_ns: IntArray
    value: FloatArray
    info: RunInfo | None
    runs: int


def series_of(path: Path, signals: SignalMap, name: str, namespace: str | None = None) -> Series:
    """One signal as it was recorded, before any clock or check.

    Raises:
        BagError: the bag cannot be read, does not fit the map, or holds no value of the signal.
        ConfigError: the map does not have the signal.
    """
    bag = AnyBag(path)
    if name not in signals.names:
        raise ConfigError(f"{signals.origin or 'signal map'}: has no signal {name}")
    (signal,) = signals.of([name])
    wiring = wire(bag, signals, namespace, [name])
    lead = max(
        signal.sources, key=lambda s: bag.topics[full_name(wiring.namespace, s.topic)].messages
    )
    latest: dict[Source, float] = {}
    stamps: list[int] = []
    values: list[float] = []
    for heard in bag.messages([t for t, s in wiring.sources.items() if {*s} & {*signal.sources}]):
        if heard.message is None:
            continue
        for source, stamp_ns, number in values_of(
            wiring.sources[heard.topic], heard.message, heard.publish_ns
        ):
            latest[source] = number
            if source != lead or any(s not in latest for s in signal.sources):
                continue
            stamps.append(stamp_ns)
            values.append(sum(math.prod(latest[s] for s in term) for term in signal.terms))
    if not stamps:
        raise BagError(f"{path}: no value of {name}")
    infos = {info.run_id: info for info in _announced(bag, wiring)}
    only = next(iter(infos.values())) if len(infos) == 1 else None
    return Series(np.array(stamps, dtype=np.int64), np.array(values), only, len(infos))
