"""A bag's power demand as a duty cycle that a player hands to the plant.

Pure and without a clock of its own. ``replay_demand`` decides when which step is published.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tractor_ems.bags.read import read_bag
from tractor_ems.bags.runs import Run
from tractor_ems.bags.sampled_traces import cycle_of_sampled_bag
from tractor_ems.bags.transitions import demand_traces
from tractor_ems.cycle_import import demand_messages
from tractor_msgs_py.errors import BagError, ConfigError
from tractor_msgs_py.refusal import refusal
from tractor_msgs_py.signals import SignalMap
from tractor_msgs_py.topics import POWER_DEMAND
from tractor_msgs_py.trajectory import FloatArray
from tractor_msgs_py.types import RunInfo
from tractor_sim.duty_cycle.cycle import DEMAND_LIMIT_W, DutyCycle, cycle_hash
from tractor_sim.duty_cycle.library import cycle_names, load_cycle

ANNOUNCED_AUX_W = -1.0
"""What a parameter says to mean "the auxiliaries that the bag announces, 0 where it does not"."""


@dataclass(frozen=True)
class DemandTrace:
    """What a bag demands, as a plant with auxiliaries of its own can drive it.

    Attributes:
        cycle: demand without auxiliaries; the run's own cycle to the last bit where the bag
            announces one whose hash its demand has.
        aux_w: auxiliary power that was taken off the record [W].
        auxiliaries: what is known of it, for people.
        irregular: stamp intervals off by more than 1 % of the step; step k is sample k all the
            same.
    """

    cycle: DutyCycle
    aux_w: float
    auxiliaries: str
    irregular: int = 0

    def cut(self, start_s: float, duration_s: float) -> "DemandTrace":
        """The steps that begin in [start_s, start_s + duration_s) [s]; duration 0: to the end.

        Raises:
            ConfigError: none does.
        """
        if start_s == 0.0 and duration_s == 0.0:
            return self
        whole, dt_s = self.cycle, self.cycle.dt_s
        first = int(np.ceil(start_s / dt_s - 1e-9))
        end = len(whole)
        if duration_s:
            end = min(end, int(np.ceil((start_s + duration_s) / dt_s - 1e-9)))
        if not first < end:
            raise ConfigError(
                f"parameters start_s, duration_s: {start_s:g}, {duration_s:g}, no step begins "
                f"there; {whole.name} is {len(whole) * dt_s:g} s of steps of {dt_s:g} s"
            )
        part = DutyCycle(
            name=f"{whole.name}[{first}:{end}]",
            power_demand_w=whole.power_demand_w[first:end],
            dt_s=dt_s,
            operation=whole.operation,
            source=whole.source,
        )
        return replace(self, cycle=part)


def demand_of(path: Path, run: int = 0, aux_w: float = ANNOUNCED_AUX_W) -> DemandTrace:
    """The demand of one run in a bag.

    Args:
        path: the bag.
        run: which, counted from 1 in the order of their start; 0: the only one.
        aux_w: auxiliary power within the recorded demand of a bag that announces none, >= 0 [W];
            :data:`ANNOUNCED_AUX_W`: what the bag announces, 0 where it does not.

    Raises:
        BagError: the bag cannot be read, has no such run or no single stretch of demand in it, or
            a demand is not finite or beyond every tractor's.
        ConfigError: ``aux_w`` contradicts what the bag announces.
    """
    if aux_w != ANNOUNCED_AUX_W and not 0.0 <= aux_w <= DEMAND_LIMIT_W:
        raise ConfigError(
            f"parameter aux_w: {aux_w:g}, allowed 0..{DEMAND_LIMIT_W:g}, or "
            f"{ANNOUNCED_AUX_W:g} for what the bag announces"
        )
    runs = [found for found in read_bag(path) if found.demand]
    if run == 0 and len(runs) != 1:
        raise BagError(f"{path}: {len(runs)} runs, parameter run says which: 1..{len(runs)}")
    if run > len(runs):
        raise BagError(f"{path}: no run {run}, allowed 1..{len(runs)}")
    chosen = runs[max(run - 1, 0)]
    _refuse_bad_demand(path, chosen)
    traces = demand_traces(chosen, str(path), "")
    if len(traces) != 1:
        raise BagError(
            f"{path}: {len(traces)} stretches of {POWER_DEMAND.name}, a replay needs exactly one; "
            "ems cycle import fills gaps"
        )
    trace, info = traces[0], chosen.info
    if info is None:
        removed_w = max(aux_w, 0.0)
        demand_w = trace.power_demand_w - removed_w
        known = aux_w != ANNOUNCED_AUX_W
        said = f"{removed_w:g} W removed (aux_w)" if known else "unknown, none removed"
    elif aux_w != ANNOUNCED_AUX_W:
        raise ConfigError(
            f"parameter aux_w: {aux_w:g}, but {path} announces auxiliaries of {info.p_aux_w:g} W; "
            "allowed only for a bag that announces none"
        )
    else:
        removed_w = info.p_aux_w
        demand_w = without_auxiliaries(trace.power_demand_w, info)
        said = f"{removed_w:g} W removed (announced)"
    cycle = DutyCycle(
        name=trace.cycle or path.stem,
        power_demand_w=demand_w,
        dt_s=trace.dt_s,
        operation="bag",
        source=str(path),
    )
    return DemandTrace(cycle, removed_w, f"auxiliaries {said}", trace.irregular)


def mapped_demand_of(path: Path, signals: SignalMap, dt_s: float) -> DemandTrace:
    """The demand of a vehicle's bag through its signal map, every ``dt_s`` [s].

    Raises:
        BagError: the bag cannot be read or does not fit the map, or demand is missing in between.
    """
    cycle = cycle_of_sampled_bag(path, signals, dt_s)
    return DemandTrace(cycle, signals.p_aux_w, f"demand through {signals.vehicle}'s signal map")


def without_auxiliaries(recorded_w: FloatArray, announced: RunInfo) -> FloatArray:
    """Demand that gives the recorded one again when the plant adds its auxiliaries, (T,) [W].

    Differences of rounded sums are not the summands: what the sums were made of is looked for
    among whole watts, as generated cycles are, and the listed cycle of that name.
    """
    aux_w = announced.p_aux_w
    rounded_w = recorded_w - aux_w
    candidates = [rounded_w, np.rint(rounded_w)]
    if announced.cycle in cycle_names():
        candidates.append(load_cycle(announced.cycle).power_demand_w[: len(recorded_w)])
    same = [
        found
        for found in candidates
        if len(found) == len(recorded_w) and np.array_equal(found + aux_w, recorded_w)
    ]
    for found in same:
        cycle = DutyCycle("", found, announced.dt_s, "")
        if cycle_hash(cycle) == announced.cycle_hash:
            return found
    # A part of a cycle has a hash of its own: the guess that is whole watts is the likelier one.
    return same[-1] if same else _nudged(rounded_w, recorded_w, aux_w)


def _nudged(demand_w: FloatArray, recorded_w: FloatArray, aux_w: float) -> FloatArray:
    """``demand_w`` by a last place up or down where that gives the record when summed."""
    for direction in (-np.inf, np.inf):
        other_w = np.nextafter(demand_w, direction)
        better = (demand_w + aux_w != recorded_w) & (other_w + aux_w == recorded_w)
        demand_w = np.where(better, other_w, demand_w)
    return demand_w


def _refuse_bad_demand(path: Path, run: Run) -> None:
    """What a reader leaves out would be a gap, or a shorter replay than the recording."""
    reasons = ("not_finite", "demand_out_of_range")
    for number, sample in enumerate(demand_messages(path, run.namespace), 1):
        if refusal(sample, None) in reasons:
            raise BagError(
                f"{path}: {POWER_DEMAND.name} is {sample.power_w} W in message {number}, allowed "
                "finite and within +-1e9 W; ems cycle import says what to do about it"
            )
