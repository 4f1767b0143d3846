"""The sampled policy for engines that start slowly: Q over "off" and knots of engine power.

Off is an output of its own, because fuel jumps there; a running engine takes the feasible knot
that measured fuel and the slope of Q over SOC make cheapest. numpy only. Training:
``learning.knot_learner``.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tractor_ems.policies.genset import power_max_w
from tractor_ems.policies.mlp import Float32Array, Mlp, forward
from tractor_ems.policies.one_step import Held, command_of, hold, not_held, running_range_w
from tractor_ems.policies.q_policy import Normalisation, demand_inputs, soc_input
from tractor_msgs_py.errors import PolicyError
from tractor_msgs_py.observation import Observation, ObservationSpec
from tractor_msgs_py.trajectory import BoolArray, FloatArray, IntArray
from tractor_sim.powertrain import Command, PowertrainParams

OFF = 0
"""Number of the output that stands for an engine that is off; knots follow."""

NEAR_END_S = 120.0
"""Time constant of the input that tells the last minutes apart."""

STATE_INPUTS = 3
"""SOC error, time left and its last minutes; after the demand's. Whether the engine runs, and at
what power, is not among them: DP's last action tells what DP knows of the future, and a network
that sees it learns to go on with whatever it does. The start fuel and the limits stand for it."""


SLOPE_STEP = 0.02
"""Half the SOC over which the slope of Q is taken."""


def knots_of(params: PowertrainParams, knots: int) -> FloatArray:
    """Engine powers at the bus that the outputs after the first stand for, (K,) [W]."""
    return np.linspace(0.0, power_max_w(params), knots)


def knot_inputs(
    scaling: Normalisation,
    demand: Float32Array,
    soc_error: FloatArray,
    time_left_s: FloatArray,
    horizon_s: float,
) -> Float32Array:
    """Inputs of the network, (B, D + 3).

    Args:
        demand: demand and filters, as ``q_policy.demand_inputs`` gives them, (B, D).
        soc_error: SOC - target, (B,).
        time_left_s: to the planned end, infinite where none is planned, (B,) [s].
        horizon_s: farthest end that the network tells from none [s].
    """
    left_s = np.clip(time_left_s, 0.0, horizon_s)
    columns = (
        soc_input(scaling, soc_error, np.zeros(1)),
        left_s / horizon_s,
        np.exp(-left_s / NEAR_END_S),
    )
    rest = np.stack([np.asarray(column, np.float32) for column in columns], axis=1)
    return np.concatenate((demand, rest), axis=1)


@dataclass(frozen=True)
class Feasible:
    """What B states allow: ``off`` (B,), and the knots ``first``..``last`` (B,), inclusive; no
    knot where ``last`` is less."""

    off: BoolArray
    first: IntArray
    last: IntArray

    def mask(self, knots: int) -> BoolArray:
        """Over all outputs, (B, 1 + K); at least one of each row."""
        index = np.arange(knots)
        run = (index >= self.first[:, None]) & (index <= self.last[:, None])
        return np.concatenate((self.off[:, None], run), axis=1)


def feasible(
    params: PowertrainParams, observation: Observation, knots: int
) -> tuple[Feasible, FloatArray, FloatArray]:
    """What may be done, and least and most power of a running engine (B,) [W], from the published
    limits and the reserve rule: ramp limit, minimum times, battery.

    A knot stands for the powers nearer to it than to its neighbours, clipped to what is allowed;
    where the engine cannot run there is no knot, and off is what is left.
    """
    least_w, most_w, may_run, may_be_off = running_range_w(params, observation)
    width_w = power_max_w(params) / (knots - 1)
    first = np.clip(np.rint(least_w / width_w), 0, knots - 1).astype(np.int64)
    last = np.clip(np.rint(most_w / width_w), first, knots - 1).astype(np.int64)
    choices = Feasible(may_be_off | ~may_run, first, np.where(may_run, last, -1))
    return choices, least_w, most_w


@dataclass(frozen=True)
class Measured:
    """What recorded steps say of power, for choosing among knots: one second at another power
    changes the return by milligrams, far below any network's error.

    Attributes:
        fuel_kg: burnt in a step at each knot, (K,); large where it was never run.
        soc_fit: see :func:`soc_gained`.
        price_kg: of one unit of SOC at the target; unit_kg: of one reward unit.
    """

    fuel_kg: tuple[float, ...]
    soc_fit: tuple[float, float, float]
    price_kg: float
    unit_kg: float


def soc_gained(fit: FloatArray, battery_w: FloatArray, soc: FloatArray) -> FloatArray:
    """SOC that a step at battery power gains, in the shape of the arguments: a fit (3,) of
    recorded steps by x, x^2 and x (SOC - 0.5), x in 100 kW."""
    x = battery_w / 1e5
    gained: FloatArray = fit[0] * x + fit[1] * x * x + fit[2] * x * (soc - 0.5)
    return gained


@dataclass(frozen=True)
class KnotQ:
    """Off where Q says so, else the knot that is cheapest at what Q's slope says SOC is worth.

    Attributes:
        params: the powertrain it was made for.
        spec: demand filters that it sees.
        net: Q of :func:`knot_inputs` as if the engine were on, one output for off and one per
            knot [reward units].
        scaling: input normalisation.
        horizon_s: see :func:`knot_inputs`.
        start_units: cost of a start, >= 0 [reward units].
        measured: what steps cost, from recordings.

    Raises PolicyError where the network does not fit the spec.
    """

    params: PowertrainParams
    spec: ObservationSpec
    net: Mlp
    scaling: Normalisation
    horizon_s: float
    measured: Measured
    start_units: float
    metadata: dict[str, Any] = field(default_factory=dict, compare=False)
    name: str = "ddqn_sampled"

    def __post_init__(self) -> None:
        inputs = 1 + len(self.spec.filters) + STATE_INPUTS
        if self.net.inputs != inputs or self.net.outputs < 3:
            raise PolicyError(
                f"network maps {self.net.inputs} inputs to {self.net.outputs} outputs, "
                f"{self.name} over engine power needs {inputs} to 3 or more"
            )
        if not (np.isfinite(self.horizon_s) and self.horizon_s > 0.0):
            raise PolicyError(f"horizon_s: {self.horizon_s}, must be finite and > 0")
        if len(self.measured.fuel_kg) != self.knots:
            raise PolicyError(
                f"measured.fuel_kg: {len(self.measured.fuel_kg)} values for {self.knots} knots"
            )
        if not 0.0 <= self.start_units <= 1e6:
            raise PolicyError(f"start_units: {self.start_units}, allowed 0..1e6")

    @property
    def knots(self) -> int:
        """Knots of engine power."""
        return self.net.outputs - 1

    def init(self, batch: int) -> Held:
        """No demand seen."""
        return not_held(batch)

    def q_values(self, observation: Observation, shift: float = 0.0) -> Float32Array:
        """Q of every output as if the engine were on and SOC higher by ``shift``, feasible or
        not, (B, 1 + K)."""
        demand_w = observation.power_demand_w
        left_s = np.broadcast_to(observation.time_left_s, demand_w.shape)
        inputs = knot_inputs(
            self.scaling,
            demand_inputs(self.scaling, demand_w, observation.features),
            observation.soc - observation.soc_target + shift,
            left_s,
            self.horizon_s,
        )
        return forward(self.net, inputs)

    def act(self, observation: Observation, state: Held) -> tuple[Command, Held]:
        """The best feasible action of every run; a held engine is not stopped."""
        choices, least_w, most_w = feasible(self.params, observation, self.knots)
        kept, held = hold(self.params, observation, state)
        mask, q = choices.mask(self.knots), self.q_values(observation)
        may_run = mask[:, 1:].any(axis=1)
        best = np.where(may_run, np.where(mask[:, 1:], q[:, 1:], -np.inf).max(axis=1), 0.0)
        start = np.where(observation.engine_on, 0.0, self.start_units)
        engine_w = np.clip(self._power_w(observation, mask), least_w, most_w)
        run = (~choices.off | kept | (best - start >= q[:, OFF])) & may_run
        return command_of(observation.power_demand_w, engine_w, run), held

    def _power_w(self, observation: Observation, mask: BoolArray) -> FloatArray:
        """The knot of least measured fuel less what the SOC it leaves is worth, (B,) [W]."""
        measured, floor = self.measured, np.where(mask, 0.0, -np.inf)
        low, high = (
            (self.q_values(observation, shift) + floor).max(axis=1)
            for shift in (-SLOPE_STEP, SLOPE_STEP)
        )
        worth_kg = measured.price_kg + (high - low) / (2.0 * SLOPE_STEP) * measured.unit_kg
        powers_w = knots_of(self.params, self.knots)
        battery_w = observation.power_demand_w[:, None] - powers_w
        gained = soc_gained(np.array(measured.soc_fit), battery_w, observation.soc[:, None])
        cost = np.array(measured.fuel_kg) - worth_kg[:, None] * gained
        chosen = np.argmin(np.where(mask[:, 1:], cost, np.inf), axis=1)
        power_w: FloatArray = powers_w[chosen]
        return power_w
