"""Can an observation be true, given the ones before it and the powertrain's physics? Pure.

It finds what a range check of one value cannot: a SOC that jumps, a SOC that is frozen while
energy flows, a demand that this powertrain could never meet. It corrects nothing.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.observation import Observation
from tractor_msgs_py.signals import range_complaint
from tractor_msgs_py.types import Reason
from tractor_sim.battery import BatteryParams, discharge_current_a, open_circuit_v
from tractor_sim.powertrain import PowertrainParams

DEMAND_FACTOR = 3.0
"""Demand beyond this many times engine and battery together is no demand: a tractor's may exceed
what it can deliver, for a second, but not by that."""

SOC_TOLERANCE = 0.02
"""A SOC may always move by this: one step of a signal in whole percent, its neighbour's noise and
the few seconds that it may be old."""

RATE_FACTOR = 2.0
"""And by this many times what the battery's largest power moves it: a real capacity is smaller
than the nominal one, never half of it."""

SOC_STEP = 0.004
"""Resolution of a usual SOC signal, one byte for 0..100 %."""

FROZEN_SOC, FROZEN_STEPS = 0.01, 3.0
"""A SOC that has not changed by a bit is frozen once the energy that flowed is worth this much
SOC, and this many of its steps."""

FLOW_GAP_S = 5.0
"""The energy that flowed between two observations further apart than this is not known [s]."""


@dataclass(frozen=True, slots=True)
class Plausible:
    """What is plausible on one powertrain; made by :func:`plausible_on`.

    Attributes:
        demand_max_w: largest demand, either sign, > 0 [W].
        soc_per_s: most that the SOC moves in a second, tolerance aside, > 0 [1/s].
        soc_tolerance: what it may always move, 0..1.
        frozen_j: energy that must have moved a SOC that lives, > 0 [J].
        battery_w: most the battery gives or takes, > 0 [W].
        empty_soc, full_soc: where it may give or take nothing any more.
    """

    demand_max_w: float
    soc_per_s: float
    soc_tolerance: float
    frozen_j: float
    battery_w: float
    empty_soc: float
    full_soc: float


@dataclass(frozen=True, slots=True)
class Seen:
    """What the observations of this run have said so far; ``Seen()`` at the start of a run.

    Attributes:
        stamp_ns: of the last observation, 0 before the first.
        sound_soc, sound_ns: the last plausible SOC and its stamp.
        soc: the last SOC, plausible or not.
        flowed_j: net energy out of the battery since ``soc`` last changed [J].
        demand_w, charge_w, discharge_w: demand and limits of the last observation [W].
    """

    stamp_ns: int = 0
    sound_soc: float = math.nan
    sound_ns: int = 0
    soc: float = math.nan
    flowed_j: float = 0.0
    demand_w: float = math.nan
    charge_w: float = math.inf
    discharge_w: float = math.inf


@dataclass(frozen=True, slots=True)
class Implausible:
    """Why an observation must not be used: the reason that travels, and a text for people that
    names signal, value and allowed range."""

    text: str
    reason: Reason = Reason.OBSERVATION_IMPLAUSIBLE


def plausible_on(
    params: PowertrainParams,
    soc_tolerance: float = SOC_TOLERANCE,
    soc_step: float = SOC_STEP,
) -> Plausible:
    """What is plausible on a powertrain.

    Args:
        params: the powertrain.
        soc_tolerance: what the SOC may move at any time, 0 < value <= 1.
        soc_step: resolution of the SOC signal, 0..0.1.

    Raises:
        ConfigError: one of them is out of range.
    """
    if not 0.0 < soc_tolerance <= 1.0:
        raise ConfigError(f"soc_tolerance: {soc_tolerance}, allowed 0 < value <= 1")
    if not 0.0 <= soc_step <= 0.1:
        raise ConfigError(f"soc_step: {soc_step}, allowed 0..0.1")
    return Plausible(
        demand_max_w=DEMAND_FACTOR * (params.engine.power_max_w + params.battery.power_max_w),
        soc_per_s=RATE_FACTOR * fastest_soc_per_s(params.battery),
        soc_tolerance=soc_tolerance,
        frozen_j=max(FROZEN_SOC, FROZEN_STEPS * soc_step) * params.battery.energy_j,
        battery_w=params.battery.power_max_w,
        empty_soc=params.battery.soc_min + soc_tolerance,
        full_soc=params.battery.soc_max - soc_tolerance,
    )


def fastest_soc_per_s(battery: BatteryParams) -> float:
    """Most that full power moves the SOC in a second: at the lowest voltage, where a power needs
    the most current."""
    if battery.lossless:
        return battery.power_max_w / battery.energy_j
    low, power_w = np.array([battery.soc_min]), np.array([battery.power_max_w])
    out_a = float(discharge_current_a(battery, low, power_w)[0])
    in_a = battery.power_max_w / float(open_circuit_v(battery, low)[0])
    fastest_a = max(
        min(out_a, battery.current_max_discharge_a), min(in_a, battery.current_max_charge_a)
    )
    return fastest_a / battery.charge_c


def judge(
    allowed: Plausible, seen: Seen, observation: Observation
) -> tuple[Seen, Implausible | None]:
    """Judge the next observation, of batch one, of the run that ``seen`` is about.

    Returns:
        What is seen now, and what is wrong with the observation; None where nothing is. After a
        jump the SOC stays implausible until it is back where it could have got to meanwhile.
    """
    demand_w, soc = float(observation.power_demand_w[0]), float(observation.soc[0])
    flowed_j = _flowed_j(allowed, seen, observation) if soc == seen.soc else 0.0
    now = replace(
        seen,
        stamp_ns=observation.stamp_ns,
        soc=soc,
        flowed_j=flowed_j,
        demand_w=demand_w,
        charge_w=float(observation.charge_limit_w[0]),
        discharge_w=float(observation.discharge_limit_w[0]),
    )
    wrong = range_complaint("soc", soc) or _jump(allowed, seen, observation.stamp_ns, soc)
    if wrong is None:
        now = replace(now, sound_soc=soc, sound_ns=observation.stamp_ns)
    wrong = wrong or _frozen(allowed, now) or _demand(allowed, demand_w)
    return now, None if wrong is None else Implausible(wrong)


def _demand(allowed: Plausible, demand_w: float) -> str | None:
    most_w = allowed.demand_max_w
    if -most_w <= demand_w <= most_w:  # False for NaN
        return None
    return (
        f"power_demand_w: {demand_w:g}, allowed {-most_w:g}..{most_w:g}, "
        f"{DEMAND_FACTOR:g} times engine and battery"
    )


def _jump(allowed: Plausible, seen: Seen, stamp_ns: int, soc: float) -> str | None:
    if not math.isfinite(seen.sound_soc):
        return None
    elapsed_s = max(stamp_ns - seen.sound_ns, 0) * 1e-9
    most = allowed.soc_tolerance + allowed.soc_per_s * elapsed_s
    if abs(soc - seen.sound_soc) <= most:
        return None
    low, high = max(seen.sound_soc - most, 0.0), min(seen.sound_soc + most, 1.0)
    return (
        f"soc: {soc:.4f}, allowed {low:.4f}..{high:.4f} {elapsed_s:.1f} s after "
        f"{seen.sound_soc:.4f}: it jumped"
    )


def _frozen(allowed: Plausible, now: Seen) -> str | None:
    if abs(now.flowed_j) <= allowed.frozen_j:
        return None
    return (
        f"soc: {now.soc:.4f} unchanged while {now.flowed_j * 1e-6:.2f} MJ left the battery, "
        f"allowed {-allowed.frozen_j * 1e-6:.2f}..{allowed.frozen_j * 1e-6:.2f} MJ: it is frozen"
    )


def _flowed_j(allowed: Plausible, seen: Seen, observation: Observation) -> float:
    """Net energy out of the battery since the SOC changed: the last demand, less what the engine
    gave, as far as the battery's limits let it. Near the ends of its window, where it takes or
    gives less than anybody may have published, nothing counts in that direction."""
    gap_s = (observation.stamp_ns - seen.stamp_ns) * 1e-9
    power_w = seen.demand_w - float(observation.engine_power_w[0])
    if not (0.0 < gap_s <= FLOW_GAP_S and math.isfinite(power_w)):
        return seen.flowed_j
    out_w = 0.0 if seen.soc <= allowed.empty_soc else allowed.battery_w
    in_w = 0.0 if seen.soc >= allowed.full_soc else allowed.battery_w
    # The published limit last: where it is NaN, min keeps the first.
    power_w = max(min(power_w, min(out_w, seen.discharge_w)), -min(in_w, seen.charge_w))
    return seen.flowed_j + power_w * gap_s
