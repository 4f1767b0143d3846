"""One step of least cost on the known plant: fuel, start, and what a policy thinks of afterwards.

For policies that differ only in that last part: ECMS (a price), SDP (a table), a learned value
(a network). Every engine power within the present limits is open to them, ramp limit and minimum
times included, except what would lean on the battery alone; see :func:`hold`.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tractor_ems.policies.genset import (
    HOLD_ON_W,
    power_knots_w,
    power_max_w,
    running_fuel_kg_per_s,
)
from tractor_ems.policies.q_policy import knot_parabola, knot_powers_w, own_limits
from tractor_ems.policies.reserve import starts_slowly
from tractor_msgs_py.observation import Observation
from tractor_msgs_py.trajectory import BoolArray, FloatArray
from tractor_sim.powertrain import Command, PowertrainParams

COARSE, FINE, LEVELS = 25, 9, 3
"""Engine powers tried over the whole range, then around the best, and how often again: to 1 kW."""

ALONE_SHARE = 0.95
"""Share of its discharge limit that the battery is planned to carry alone in light work."""

HEAVY_SHARE = 0.6
"""The same in heavy work, whose demand rises by up to 0.3 of rated power in a second: from there
the battery and the first second of a restart still meet it."""

BESIDE_SHARE = 0.5
"""Share planned beside a running engine: the rest is for a rise faster than the engine's ramp."""

PEAK_FADE_S = 1500.0
"""How slowly the peak is forgotten by which work is told light or heavy [s]."""

HOLD_S = 60.0
"""How long an engine is kept in heavy work after demand that only it makes safe [s]: longer than
a headland turn of 31-40 s with its ramps, and about what a start costs in idling. (45 s stopped
it just before the next pass, and for the 5 s that it must then stand demand was not met.)"""

RESTART_SHARE = 0.9
"""Share of one step's ramp that a restart is counted on for."""


@dataclass(frozen=True)
class Held:
    """What the reserve remembers, (B,): faded peak demand, < 0 before the first [W]; time since
    demand was more than :data:`HEAVY_SHARE` of what the battery can give [s]."""

    peak_w: FloatArray
    since_s: FloatArray


def not_held(batch: int) -> Held:
    """Nothing seen yet."""
    return Held(np.full(batch, -1.0), np.full(batch, 1e9))


def hold(
    params: PowertrainParams, observation: Observation, state: Held
) -> tuple[BoolArray, Held]:
    """Whether the engine is to run whatever it costs, (B,), and the next memory.

    Where an engine is not back at once, demand beyond the battery is met by running it early
    (:data:`ALONE_SHARE`). Work whose recent peak is beyond the battery is heavy: there the engine
    runs from :data:`HEAVY_SHARE` on and is kept for :data:`HOLD_S`. Work begins as heavy and is
    light after ten minutes without such a peak.
    """
    demand_w, limits = observation.power_demand_w, own_limits(params, observation)
    if not starts_slowly(params):
        return np.zeros(demand_w.shape, dtype=bool), state
    ramp_w = min(params.engine.ramp_w_per_s * params.dt_s, params.engine.power_max_w)
    expected_w = limits.discharge_w + RESTART_SHARE * ramp_w
    faded_w = np.where(
        state.peak_w < 0.0, expected_w, state.peak_w * math.exp(-params.dt_s / PEAK_FADE_S)
    )
    peak_w = np.maximum(demand_w, faded_w)
    safe = demand_w <= HEAVY_SHARE * limits.discharge_w
    since_s = np.where(safe, state.since_s + params.dt_s, 0.0)
    heavy = peak_w > ALONE_SHARE * limits.discharge_w
    beyond = np.where(heavy, ~safe, demand_w > ALONE_SHARE * limits.discharge_w)
    kept = observation.engine_on & heavy & (since_s < HOLD_S)
    return beyond | kept, Held(peak_w, since_s)


Continuation = Callable[[FloatArray], FloatArray]
"""Cost of what follows battery powers (B, K) at the bus, (B, K) [kg]."""


def running_range_w(
    params: PowertrainParams, observation: Observation
) -> tuple[FloatArray, FloatArray, BoolArray, BoolArray]:
    """Least and most bus power of a running engine (B,) [W]; whether it may run, may be off."""
    limits, demand_w = own_limits(params, observation), observation.power_demand_w
    most_w = np.minimum(limits.engine_w, demand_w + limits.charge_w)
    least_w = np.maximum(limits.engine_least_w, demand_w - limits.discharge_w)
    least_w = np.maximum(least_w, HOLD_ON_W)
    may_be_off = limits.may_be_off & (demand_w <= limits.discharge_w)
    if starts_slowly(params):
        support_w = demand_w - BESIDE_SHARE * limits.discharge_w
        least_w = np.maximum(least_w, np.minimum(support_w, most_w))
    return np.minimum(least_w, most_w), most_w, limits.engine_w > 0.0, may_be_off


def cheapest(
    params: PowertrainParams,
    demand_w: FloatArray,
    least_w: FloatArray,
    most_w: FloatArray,
    after_on: Continuation,
) -> tuple[FloatArray, FloatArray]:
    """Engine power of least fuel + ``after_on`` between two powers, and that cost, (B,) each.

    ``after_on`` enters as a parabola through its values at both ends and the middle: one step
    moves SOC so little that nothing else is left of it.
    """
    unit_w = params.battery.power_max_w
    knots_w = knot_powers_w(demand_w - most_w, demand_w - least_w)
    c = knot_parabola(knots_w, after_on(knots_w), unit_w)[:, :, None]
    bus_w = power_knots_w(params)
    fuel_kg = running_fuel_kg_per_s(params, bus_w) * params.dt_s
    low, high, points = least_w, most_w, COARSE
    row = np.arange(len(demand_w))
    for _ in range(LEVELS):
        engine_w = low[:, None] + (high - low)[:, None] * np.linspace(0.0, 1.0, points)
        x = (demand_w[:, None] - engine_w) / unit_w
        cost = np.interp(engine_w, bus_w, fuel_kg) + c[:, 0] + x * (c[:, 1] + x * c[:, 2])
        found = np.argmin(cost, axis=1)
        best_w, best = engine_w[row, found], cost[row, found]
        step_w = (high - low) / (points - 1)
        low = np.maximum(best_w - step_w, least_w)
        high, points = np.minimum(best_w + step_w, most_w), FINE
    return best_w, best


def unhurried_range_w(
    params: PowertrainParams, demand_w: FloatArray, observation: Observation
) -> tuple[FloatArray, FloatArray]:
    """The same without the ramp limit: it lasts seconds, running does not."""
    most_w = np.minimum(power_max_w(params), demand_w + observation.charge_limit_w)
    least_w = np.maximum(demand_w - observation.discharge_limit_w, HOLD_ON_W)
    return np.minimum(least_w, most_w), np.maximum(most_w, HOLD_ON_W)


def command_of(demand_w: FloatArray, engine_w: FloatArray, run: BoolArray) -> Command:
    """Run at a power, or off."""
    return Command(np.where(run, demand_w - engine_w, demand_w), np.where(run, np.nan, 0.0))
