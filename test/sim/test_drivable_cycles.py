"""Every listed cycle can be driven on ``field`` from SOC 0.55 back to 0.55 without shortfall.

Shown by construction: a driver who sees the work of the next seconds coming drives it.
"""

from collections import defaultdict

import numpy as np
import pytest

from tractor_sim.config import load_powertrain
from tractor_sim.duty_cycle.library import (
    generate_cycle,
    listed_cycles,
    load_cycle,
    operations,
)
from tractor_sim.powertrain import Command, initial_state, power_limits, step

AHEAD_S = 8
"""Longer than the ramp from standstill to full engine power, 253 kW at 60 kW/s."""

FIELD = load_powertrain("field")


def needed_soc(demand_w, engine_w):
    """SOC that the battery must have before each step to end at the target, shape (B, T).

    With the engine at full power and 7 % lost on the way through the battery.
    """
    need = np.empty_like(demand_w)
    after = np.full(len(demand_w), FIELD.soc_initial)
    for k in reversed(range(demand_w.shape[1])):
        drain_w = demand_w[:, k] - engine_w
        drain_w = np.where(drain_w > 0, drain_w / 0.93, drain_w * 0.93)
        after = np.maximum(after + drain_w / FIELD.battery.energy_j, FIELD.soc_initial)
        need[:, k] = after
    return need


def drive(demand_w):
    """Final SOC and undelivered energy per step of B cycles, demand shape (B, T) at the bus.

    The engine follows demand, keeps the battery where it has to be, and rises early enough that
    both together meet what is coming; it never stops once it runs.
    """
    state = initial_state(FIELD, FIELD.soc_initial, len(demand_w))
    need = needed_soc(demand_w, 240e3)
    padded_w = np.pad(demand_w, ((0, 0), (0, AHEAD_S)), mode="edge")
    shortfall_j = np.zeros_like(demand_w)
    ramp_w = 0.9 * FIELD.engine.ramp_w_per_s
    for k in range(demand_w.shape[1]):
        limits = power_limits(FIELD, state)
        coming_w = padded_w[:, k : k + AHEAD_S]
        early_w = coming_w - 0.95 * limits.discharge_w[:, None] - ramp_w * np.arange(AHEAD_S)
        recovery_w = (need[:, k] + 0.005 - state.soc) * FIELD.battery.energy_j / 10.0
        engine_w = np.maximum(demand_w[:, k] + recovery_w, early_w.max(axis=1))
        engine_w = np.maximum(engine_w, 1e3)
        command = Command(demand_w[:, k] - engine_w, np.full(len(demand_w), np.nan))
        state, result = step(FIELD, state, demand_w[:, k], command)
        shortfall_j[:, k] = result.shortfall_j
    return state.soc, shortfall_j


def check(demands_w):
    """Names with demand at the bus, auxiliaries included: all driven, none short."""
    by_length = defaultdict(list)
    for name, demand_w in demands_w:
        by_length[len(demand_w)].append((name, demand_w))
    for cycles in by_length.values():
        soc, shortfall_j = drive(np.stack([demand_w for _, demand_w in cycles]))
        for (name, _), end, lost_j in zip(cycles, soc, shortfall_j, strict=True):
            assert lost_j.sum() == 0, (name, int(np.argmax(lost_j)))
            assert end >= FIELD.soc_initial, (name, end)


def at_bus_w(cycle):
    return cycle.power_demand_w + FIELD.p_aux_w


def test_every_listed_cycle_is_driven():
    check((row.name, at_bus_w(load_cycle(row.name))) for row in listed_cycles())


@pytest.mark.slow
@pytest.mark.parametrize("operation", operations())
def test_every_generated_cycle_is_driven(operation):
    cycles = (generate_cycle(operation, seed) for seed in range(3000, 3040))
    check((cycle.name, at_bus_w(cycle)) for cycle in cycles)
