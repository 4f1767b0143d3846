"""Sampled bags as traces to learn from, and as duty cycles; see ``transitions`` for bags of the
project's own topics."""

from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from tractor_ems.bags.read import find_bags
from tractor_ems.bags.sampled import NEEDED, SampledBag, SampledRun, read_sampled
from tractor_ems.bags.transitions import Trace
from tractor_ems.signals.vehicle import sampled_spec
from tractor_msgs_py.codec import wire_soc
from tractor_msgs_py.errors import BagError
from tractor_msgs_py.observation import SampledTick
from tractor_msgs_py.signals import SignalMap
from tractor_msgs_py.trajectory import BoolArray, FloatArray
from tractor_sim.duty_cycle.cycle import DutyCycle

STATES = ("soc", "battery_power_w", "fuel_kg_per_s")
"""Signals besides demand and engine without which a tick is not part of a driven trace."""

DRIVEN = (*NEEDED, *STATES)
"""All of them; engine power follows from the balance where it is not there."""


def iter_sampled_traces(
    paths: Iterable[Path],
    signals: SignalMap,
    dt_s: float,
    *,
    namespace: str | None = None,
    driven: bool = False,
) -> list[Trace]:
    """Every trace in the bags at or below ``paths``, in a fixed order.

    Args:
        paths: bags, or folders of bags.
        signals: where their signals are.
        dt_s: step [s].
        namespace: of the map's relative topics; None: the only one that fits.
        driven: cut also where a state is missing, so that the rest can be replayed; else only
            where demand is.

    Raises:
        BagError: a bag cannot be read or does not fit the map, or its values are implausible.
    """
    spec = sampled_spec(signals, dt_s, needed=NEEDED)
    traces: list[Trace] = []
    for path in find_bags(paths):
        bag = read_sampled(path, signals, spec, namespace=namespace)
        found = traces_of_sampled(bag, signals, dt_s, driven=driven)
        refuse_implausible(bag)
        traces += found
    return traces


def refuse_implausible(bag: SampledBag) -> None:
    """What must not be learned from: a signal that is out of range is in the wrong unit.

    Raises:
        BagError: so, in more than a tenth of the ticks.
    """
    for name, text in bag.complaints.items():
        wrong = [
            tick.frame.missing.get(name) == "implausible" for run in bag.runs for tick in run.ticks
        ]
        if sum(wrong) > 0.1 * len(wrong):
            raise BagError(f"{bag.path}: {text} ({sum(wrong)} of {len(wrong)} ticks)")


def traces_of_sampled(
    bag: SampledBag, signals: SignalMap, dt_s: float, *, driven: bool = False
) -> list[Trace]:
    """The traces of a sampled bag.

    Powers and fuel of step k are those that were sampled at t_{k+1}: what was applied over the
    period that ends there. So a trace with states has a step less than it has ticks.

    Raises:
        BagError: no two ticks in a row have a demand, or, ``driven``, all states.
    """
    dt_ns = round(dt_s * 1e9)
    traces = []
    for run in bag.runs:
        there = [_usable(tick, driven) for tick in run.ticks]
        begin = next((k for k, ok in enumerate(there) if ok), 0)
        edges = [
            k + 1
            for k, (a, b) in enumerate(pairwise(run.ticks))
            if b.frame.stamp_ns - a.frame.stamp_ns != dt_ns or there[k] != there[k + 1]
        ]
        for first, last in pairwise([0, *edges, len(run.ticks)]):
            if last - first > 1 and there[first]:
                part = run.ticks[first:last]
                traces.append(_trace(bag, run, part, signals, dt_s, first == begin))
    if not traces:
        wanted = "all that a drive needs" if driven else "a power_demand_w"
        known = {name for run in bag.runs for tick in run.ticks for name in tick.frame.values}
        lacking = [name for name in DRIVEN if driven and name not in known]
        never = f" ({', '.join(lacking)} never)" if lacking else ""
        raise BagError(
            f"{bag.path}: no two ticks of {dt_s:g} s in a row with {wanted}{never}"
            + "".join(f"; {text}" for text in bag.complaints.values())
        )
    return traces


def _usable(tick: SampledTick, driven: bool) -> bool:
    values = tick.frame.values
    if not driven:
        return "power_demand_w" in values
    return tick.observation is not None and all(name in values for name in STATES)


def _column(ticks: Sequence[SampledTick], name: str) -> FloatArray | None:
    """A signal at every tick, or None where a tick is without."""
    if not all(name in tick.frame.values for tick in ticks):
        return None
    return np.array([tick.frame.values[name] for tick in ticks])


def _trace(
    bag: SampledBag,
    run: SampledRun,
    ticks: Sequence[SampledTick],
    signals: SignalMap,
    dt_s: float,
    from_start: bool,
) -> Trace:
    demand_w = _column(ticks, "power_demand_w")
    assert demand_w is not None
    soc = _column(ticks, "soc")
    stamps = np.array([tick.frame.stamp_ns for tick in ticks], dtype=np.int64)
    battery_w = engine_w = fuel = time_in_state_s = None
    engine_on: BoolArray | None = None
    if soc is not None:  # ticks are states: the last one only ends a step
        stamps, demand_w = stamps[:-1], demand_w[:-1]
        battery_w, fuel = _column(ticks, "battery_power_w"), _column(ticks, "fuel_kg_per_s")
        engine_w = _column(ticks, "engine_power_w")
        seen = [tick.observation for tick in ticks if tick.observation is not None]
        if len(seen) == len(ticks):
            engine_on = np.array([bool(o.engine_on[0]) for o in seen])
            time_in_state_s = np.array([float(o.time_in_state_s[0]) for o in seen])
    if engine_w is None and battery_w is not None:
        engine_w = np.append(0.0, demand_w - battery_w[1:])
    info = run.info
    return Trace(
        stamp_ns=stamps,
        power_demand_w=demand_w,
        dt_s=dt_s,
        p_aux_w=info.p_aux_w if run.announced else signals.p_aux_w,
        soc=None if soc is None else wire_soc(soc),
        battery_power_w=None if battery_w is None else battery_w[1:],
        engine_power_w=None if engine_w is None else engine_w[1:],
        engine_on=engine_on,
        time_in_state_s=time_in_state_s,
        fuel_kg=None if fuel is None else fuel[1:] * dt_s,
        shortfall_j=None,
        dissipated_j=None,
        soc_target=info.soc_target if run.announced else signals.soc_target,
        from_start=from_start,
        to_end=ticks[-1] is run.ticks[-1],
        irregular=0,
        refusals=bag.refused_samples,
        run_id=info.run_id if run.announced else "",
        cycle=info.cycle,
        cycle_hash=info.cycle_hash,
        powertrain=info.powertrain,
        powertrain_hash=info.powertrain_hash,
        policy=bag.provenance.get(f"policy:{info.run_id}", ""),
        bag=str(bag.path),
        bag_hash=bag.sha256,
    )


def cycle_of_sampled_bag(
    path: Path, signals: SignalMap, dt_s: float, namespace: str | None = None
) -> DutyCycle:
    """The duty cycle in a vehicle's bag: its demand every ``dt_s``, less the auxiliaries.

    Raises:
        BagError: the bag cannot be read or does not fit the map, or demand is missing in between.
    """
    spec = sampled_spec(signals, dt_s, needed=NEEDED)
    bag = read_sampled(path, signals, spec, namespace=namespace)
    found = traces_of_sampled(bag, signals, dt_s)
    refuse_implausible(bag)
    if len(found) != 1:
        raise BagError(
            f"{path}: {len(found)} stretches of demand, a cycle needs exactly one "
            "(ems cycle import fills gaps)"
        )
    trace = found[0]
    return DutyCycle(
        name=trace.cycle or path.stem,
        power_demand_w=trace.power_demand_w - trace.p_aux_w,
        dt_s=dt_s,
        operation="bag",
        source=str(path),
    )
