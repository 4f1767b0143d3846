"""Cycles that settings are tuned on, and the optimum of each: never a held-out one."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from tractor_ems.tuning.reference import Reference
from tractor_ems.tuning.squeeze import squeezed
from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.duty_cycle.library import load_cycle
from tractor_sim.duty_cycle.shipped import refuse_held_out
from tractor_sim.powertrain import PowertrainParams
from tractor_sim.powertrain_json import powertrain_hash

TIME_SHARES, POWER_SCALES = (0.25, 0.6), (0.4, 0.8)
"""How far the work of the squeezed set is compressed and made lighter."""


@dataclass(frozen=True)
class DevCycle:
    """One cycle to tune on: demand at the bus, auxiliaries included [W], and its optimum."""

    name: str
    power_demand_w: FloatArray
    reference: Reference


@lru_cache(maxsize=512)
def bus_demand_w(name: str, p_aux_w: float) -> FloatArray:
    """Demand of a shipped cycle at the bus [W].

    Raises:
        CycleError: no such cycle. ConfigError: it is held out.
    """
    cycle = load_cycle(name)
    refuse_held_out(cycle)
    return np.ascontiguousarray(cycle.power_demand_w + p_aux_w)


def dev_set(
    params: PowertrainParams, names: Sequence[str], soc: float, kept: Path | None = None
) -> tuple[DevCycle, ...]:
    """The named cycles from one SOC; optima are kept below the folder ``kept``.

    Raises:
        CycleError: no such cycle. ConfigError: one is held out.
    """
    return tuple(
        _cycle(params, name, bus_demand_w(name, params.p_aux_w), soc, kept) for name in names
    )


def squeezed_set(
    params: PowertrainParams,
    names: Sequence[str],
    soc: float,
    seed: int,
    kept: Path | None = None,
) -> tuple[DevCycle, ...]:
    """The named cycles, each squeezed by shares drawn from one generator: work of short strokes
    that nothing was trained on."""
    rng = np.random.Generator(np.random.PCG64(seed))
    found = []
    for name in names:
        share, scale = rng.uniform(*TIME_SHARES), rng.uniform(*POWER_SCALES)
        demand_w = squeezed(bus_demand_w(name, params.p_aux_w), params.p_aux_w, share, scale)
        found.append(_cycle(params, f"squeezed_{seed}_{name}", demand_w, soc, kept))
    return tuple(found)


def _cycle(
    params: PowertrainParams, name: str, demand_w: FloatArray, soc: float, kept: Path | None
) -> DevCycle:
    label = f"{name}_{round(1e4 * soc)}_{powertrain_hash(params)[:12]}.json"
    path = None if kept is None else kept / label
    return DevCycle(name, demand_w, Reference(params, demand_w, soc, path))
