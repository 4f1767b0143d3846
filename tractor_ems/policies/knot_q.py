"""The sampled policy for engines that start slowly: Q over "off" and knots of engine power.

Off is an output of its own, because fuel jumps there; a running engine's power is a mean over the
feasible knots, weighted by their Q. numpy only. Training: ``learning.knot_learner``.
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

STATE_INPUTS = 5
"""SOC error, engine on, engine power, time left and its last minutes; after the demand's."""


def knots_of(params: PowertrainParams, knots: int) -> FloatArray:
    """Engine powers at the bus that the outputs after the first stand for, (K,) [W]."""
    return np.linspace(0.0, power_max_w(params), knots)


def knot_inputs(
    scaling: Normalisation,
    demand: Float32Array,
    soc_error: FloatArray,
    engine_on: BoolArray,
    engine_share: FloatArray,
    time_left_s: FloatArray,
    horizon_s: float,
) -> Float32Array:
    """Inputs of the network, (B, D + 5).

    Args:
        demand: demand and filters, as ``q_policy.demand_inputs`` gives them, (B, D).
        soc_error: SOC - target, (B,).
        engine_share: engine power over the most it can give, before the decision, (B,).
        time_left_s: to the planned end, infinite where none is planned, (B,) [s].
        horizon_s: farthest end that the network tells from none [s].
    """
    left_s = np.clip(time_left_s, 0.0, horizon_s)
    columns = (
        soc_input(scaling, soc_error, np.zeros(1)),
        engine_on,
        engine_share,
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
class KnotQ:
    """Off where Q says so, else at the knots' mean power.

    Attributes:
        params: the powertrain it was made for.
        spec: demand filters that it sees.
        net: Q of :func:`knot_inputs`, one output for off and one per knot [reward units].
        scaling: input normalisation.
        horizon_s: see :func:`knot_inputs`.
        temperature: of the weights exp(Q / temperature) of the knots, > 0 [reward units].

    Raises PolicyError where the network does not fit the spec.
    """

    params: PowertrainParams
    spec: ObservationSpec
    net: Mlp
    scaling: Normalisation
    horizon_s: float
    temperature: float
    metadata: dict[str, Any] = field(default_factory=dict, compare=False)
    name: str = "ddqn_sampled"

    def __post_init__(self) -> None:
        inputs = 1 + len(self.spec.filters) + STATE_INPUTS
        if self.net.inputs != inputs or self.net.outputs < 3:
            raise PolicyError(
                f"network maps {self.net.inputs} inputs to {self.net.outputs} outputs, "
                f"{self.name} over engine power needs {inputs} to 3 or more"
            )
        for name in ("horizon_s", "temperature"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise PolicyError(f"{name}: {value}, must be finite and > 0")

    @property
    def knots(self) -> int:
        """Knots of engine power."""
        return self.net.outputs - 1

    def init(self, batch: int) -> Held:
        """No demand seen."""
        return not_held(batch)

    def q_values(self, observation: Observation) -> Float32Array:
        """Q of every output, feasible or not, (B, 1 + K) [reward units]."""
        demand_w = observation.power_demand_w
        left_s = np.broadcast_to(observation.time_left_s, demand_w.shape)
        inputs = knot_inputs(
            self.scaling,
            demand_inputs(self.scaling, demand_w, observation.features),
            observation.soc - observation.soc_target,
            observation.engine_on,
            observation.engine_power_w / power_max_w(self.params),
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
        running = np.where(mask[:, 1:], q[:, 1:], -np.inf)
        best = np.where(may_run, running.max(axis=1), 0.0)
        weight = np.exp((running - best[:, None]) / self.temperature)
        power_w = weight @ knots_of(self.params, self.knots)
        engine_w = np.clip(power_w / np.maximum(weight.sum(axis=1), 1e-30), least_w, most_w)
        run = (~choices.off | kept | (best >= q[:, OFF])) & may_run
        return command_of(observation.power_demand_w, engine_w, run), held
