"""The learned policies: a Q-network over the action grid, or a post-decision value with the known
plant in front of it. numpy and safetensors only: neither torch nor a validation library.
"""

import reprlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from tractor_ems.learning.rewards import RewardConfig, battery_price, running_cost, start_cost
from tractor_ems.policies.action_grid import feasible_range, in_range
from tractor_ems.policies.mlp import Float32Array, Mlp, forward
from tractor_ems.policies.policy_file import network_of, params_of, read_policy, write_policy_file
from tractor_ems.policies.protocol import limits_of
from tractor_msgs_py.errors import PolicyError
from tractor_msgs_py.observation import Observation, ObservationSpec
from tractor_msgs_py.trajectory import BoolArray, FloatArray
from tractor_sim.battery import soc_after
from tractor_sim.powertrain import (
    Command,
    PlantState,
    PowerLimits,
    PowertrainParams,
    battery_power_grid_w,
    feasible_battery_power_w,
    power_limits,
    project,
)
from tractor_sim.powertrain_json import params_to_json, powertrain_hash

Kind = Literal["ddqn_counterfactual", "ddqn_sampled"]
KINDS: tuple[Kind, ...] = ("ddqn_counterfactual", "ddqn_sampled")

LAYERS_MAX = 16
ACTIONS_MIN, ACTIONS_MAX = 2, 30_000


@dataclass(frozen=True)
class Normalisation:
    """How signals become network inputs.

    Attributes:
        demand_offset_w, demand_scale_w: demand and its filters enter as (P - offset) / scale.
        soc_scale: SOC enters as (SOC - SOC_target) / scale, so that the target comes with the run.
    """

    demand_offset_w: float
    demand_scale_w: float
    soc_scale: float = 0.05

    def __post_init__(self) -> None:
        for name in ("demand_offset_w", "demand_scale_w", "soc_scale"):
            value = getattr(self, name)
            if not np.isfinite(value) or (name != "demand_offset_w" and value <= 0):
                raise PolicyError(f"normalisation.{name}: {value}, must be finite, scales > 0")


def demand_inputs(
    scaling: Normalisation, power_demand_w: FloatArray, features_w: FloatArray
) -> Float32Array:
    """Demand (B,) and its filters (B, F) as network inputs, shape (B, 1 + F)."""
    signals = np.concatenate((power_demand_w[:, None], features_w), axis=1)
    scaled = (signals - scaling.demand_offset_w) / scaling.demand_scale_w
    return scaled.astype(np.float32)


def soc_input(scaling: Normalisation, soc: FloatArray, soc_target: FloatArray) -> Float32Array:
    """Distance from the target as a network input, the shape of ``soc``."""
    return ((soc - soc_target) / scaling.soc_scale).astype(np.float32)


def state_inputs(
    scaling: Normalisation, demand: Float32Array, soc_error: Float32Array, engine_on: BoolArray
) -> Float32Array:
    """Inputs of the Q-network: demand and filters, SOC error, engine state; shape (B, 3 + F)."""
    return np.concatenate(
        (demand, soc_error[:, None], engine_on[:, None].astype(np.float32)), axis=1
    )


def split_values(outputs: Float32Array, start_units: float) -> tuple[Float32Array, Float32Array]:
    """W_on and W_off from the network's two outputs: W_off = W_on + start * sigmoid, because an
    engine that is off is worth at most one start more to have on."""
    w_on = outputs[..., 0]
    sigmoid = 0.5 + 0.5 * np.tanh(0.5 * outputs[..., 1])
    w_off: Float32Array = w_on + np.float32(start_units) * sigmoid
    return w_on, w_off


def knot_powers_w(lb: FloatArray, ub: FloatArray) -> FloatArray:
    """Three battery powers that span the feasible range, shape (B, 3) [W]."""
    top = np.maximum(lb, ub)
    return np.stack((lb, 0.5 * (lb + top), top), axis=1)


def knot_parabola(knots_w: FloatArray, values: FloatArray, unit_w: float) -> FloatArray:
    """Coefficients c of c0 + c1 x + c2 x^2, x = P / unit, through three equidistant knots.

    One step moves SOC so little that what follows it is a parabola in P_batt to within rounding.
    Shape (B, 3). A range without width gets a constant.
    """
    half = 0.5 * (knots_w[:, 2] - knots_w[:, 0]) / unit_w
    wide = half > 1e-6
    safe = np.where(wide, half, 1.0)
    middle = knots_w[:, 1] / unit_w
    low, centre, high = values[:, 0], values[:, 1], values[:, 2]
    slope = np.where(wide, 0.5 * (high - low) / safe, 0.0)
    bend = np.where(wide, 0.5 * (high - 2.0 * centre + low) / safe**2, 0.0)
    return np.stack(
        (centre - slope * middle + bend * middle**2, slope - 2 * bend * middle, bend), 1
    )


@dataclass(frozen=True)
class QPolicy:
    """A trained policy. Every random number was drawn in training; this one is deterministic.

    Attributes:
        name: ``ddqn_counterfactual`` or ``ddqn_sampled``.
        spec: what it needs to see.
        params: the powertrain it was made for.
        reward: the reward it was trained on, resolved.
        net: counterfactual: post-decision value of (demand inputs, SOC' error), two outputs.
            sampled: Q of (demand inputs, SOC error, engine state), one output per action.
        scaling: input normalisation.
        gamma: discount per step.
        actions: size of the action grid.
        metadata: where it came from, as stored in its file.
    """

    name: Kind
    spec: ObservationSpec
    params: PowertrainParams
    reward: RewardConfig
    net: Mlp
    scaling: Normalisation
    gamma: float
    actions: int = 1600
    metadata: dict[str, Any] = field(default_factory=dict, compare=False)
    grid_w: FloatArray = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        demand_columns = 1 + len(self.spec.filters)
        if self.name == "ddqn_counterfactual":
            inputs, outputs = demand_columns + 1, 2
        else:
            inputs, outputs = demand_columns + 2, self.actions
        if (self.net.inputs, self.net.outputs) != (inputs, outputs):
            raise PolicyError(
                f"network maps {self.net.inputs} inputs to {self.net.outputs} outputs, "
                f"{self.name} with this observation needs {inputs} to {outputs}"
            )
        if not 0.0 <= self.gamma < 1.0:
            raise PolicyError(f"gamma: {self.gamma}, allowed 0 <= gamma < 1")
        object.__setattr__(self, "grid_w", battery_power_grid_w(self.params, self.actions))

    def init(self, batch: int) -> None:
        """No memory beyond the observation's filters."""
        return None

    def act(self, observation: Observation, state: None) -> tuple[Command, None]:
        """The best feasible action of every run."""
        demand_w = observation.power_demand_w
        lb, ub = feasible_battery_power_w(own_limits(self.params, observation), demand_w)
        if self.name == "ddqn_counterfactual":
            battery_w = self._by_value(observation, lb, ub)
        else:
            battery_w = self._by_q(observation, lb, ub)
        off = battery_w >= demand_w
        return Command(battery_w, np.where(off, 0.0, np.nan)), state

    def q_values(self, observation: Observation) -> Float32Array:
        """Q of all actions, feasible or not, shape (B, actions); sampled policies only."""
        demand = demand_inputs(self.scaling, observation.power_demand_w, observation.features)
        error = soc_input(self.scaling, observation.soc, observation.soc_target)
        return forward(self.net, state_inputs(self.scaling, demand, error, observation.engine_on))

    def _by_q(self, observation: Observation, lb: FloatArray, ub: FloatArray) -> FloatArray:
        first, last = feasible_range(self.grid_w, lb, ub)
        q = np.where(in_range(first, last, self.actions), self.q_values(observation), -np.inf)
        return project(self.grid_w[np.argmax(q, axis=1)], lb, ub)

    def _by_value(self, observation: Observation, lb: FloatArray, ub: FloatArray) -> FloatArray:
        cost, candidates_w = self.action_costs(observation, lb, ub)
        chosen = np.argmin(cost, axis=1)[:, None]
        battery_w: FloatArray = np.take_along_axis(candidates_w, chosen, axis=1)[:, 0]
        return battery_w

    def action_costs(
        self, observation: Observation, lb: FloatArray, ub: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Cost of every action and the battery power it means, shapes (B, actions).

        Known plant, learned future: running cost + start + battery price + gamma W.
        """
        params, demand_w = self.params, observation.power_demand_w
        candidates_w = project(self.grid_w[None, :], lb[:, None], ub[:, None])
        engine_w = np.maximum(demand_w[:, None] - candidates_w, 0.0)
        on = engine_w > 0.0
        start = start_cost(self.reward, params)
        cost = running_cost(self.reward, params, engine_w, on)
        cost = cost + np.where(on & ~observation.engine_on[:, None], start, 0.0)
        knots_w = knot_powers_w(lb, ub)
        demand = demand_inputs(self.scaling, demand_w, observation.features)
        after_on, after_off = self.continuation(
            demand, observation.soc, observation.soc_target, knots_w
        )
        unit_w = params.battery.power_max_w
        c = knot_parabola(knots_w, after_on, unit_w)[:, :, None]
        x = candidates_w / unit_w
        return cost + np.where(
            on, c[:, 0] + x * (c[:, 1] + x * c[:, 2]), after_off[:, 2:]
        ), candidates_w

    def continuation(
        self,
        demand: Float32Array,
        soc: FloatArray,
        soc_target: FloatArray,
        battery_power_w: FloatArray,
    ) -> tuple[FloatArray, FloatArray]:
        """Battery price + gamma W after powers of shape (B, K), engine on and off, (B, K) each."""
        params = self.params
        soc, target = soc[:, None], soc_target[:, None]
        soc_next = soc_after(params.battery, soc, battery_power_w, params.dt_s)
        price = battery_price(self.reward, params, soc, soc_next, target)
        knots = battery_power_w.shape[1]
        error = soc_input(self.scaling, soc_next, target)
        inputs = np.concatenate((np.repeat(demand, knots, axis=0), error.reshape(-1, 1)), axis=1)
        outputs = forward(self.net, inputs).reshape(*battery_power_w.shape, 2)
        unit = self.reward.cost_unit
        w_on, w_off = split_values(outputs, start_cost(self.reward, params) / unit)
        scale = self.gamma * unit
        return price + scale * w_on, price + scale * w_off


def own_limits(params: PowertrainParams, observation: Observation) -> PowerLimits:
    """The powertrain's limits as the policy knows them, cut to the published present ones."""
    state = PlantState(
        observation.soc,
        observation.engine_on,
        observation.time_in_state_s,
        observation.engine_power_w,
    )
    own, published = power_limits(params, state), limits_of(observation)
    return PowerLimits(
        charge_w=np.minimum(own.charge_w, published.charge_w),
        discharge_w=np.minimum(own.discharge_w, published.discharge_w),
        engine_w=np.minimum(own.engine_w, published.engine_w),
        engine_least_w=np.minimum(own.engine_least_w, published.engine_w),
        may_be_off=own.may_be_off,
    )


def save_policy(path: Path, policy: QPolicy) -> None:
    """Write a policy file, whole or not at all; equal policies give equal bytes.

    Raises:
        PolicyError: a weight is not finite.
        ConfigError: the folder cannot be written to.
    """
    tensors = {}
    for number, (weight, bias) in enumerate(
        zip(policy.net.weights, policy.net.biases, strict=True)
    ):
        tensors[f"layer{number}.weight"] = weight
        tensors[f"layer{number}.bias"] = bias
    reward = policy.reward
    metadata = {
        **policy.metadata,
        "kind": policy.name,
        "observation": policy.spec.to_json(),
        "powertrain": params_to_json(policy.params),
        "powertrain_hash": powertrain_hash(policy.params),
        "reward": {
            "kind": reward.kind,
            "lambda0_kg_per_j": reward.lambda0_kg_per_j,
            "kp": reward.kp,
            "start_price_kg": reward.start_price_kg,
        },
        "normalisation": {
            "demand_offset_w": policy.scaling.demand_offset_w,
            "demand_scale_w": policy.scaling.demand_scale_w,
            "soc_scale": policy.scaling.soc_scale,
        },
        "network": {
            "layers": len(policy.net.weights),
            "activation": policy.net.activation,
        },
        "gamma": policy.gamma,
        "actions": policy.actions,
    }
    write_policy_file(path, tensors, metadata)


def load_policy(path: str | Path) -> QPolicy:
    """Read a policy file of one of :data:`KINDS`; ``made.load_made`` reads those of every kind.

    Raises:
        PolicyError: the file is missing, cut short, not a policy file, of an unknown version or
            kind, damaged, or its tensors do not have the shapes its metadata promises.
    """
    return read_policy(Path(path), policy_from)


def policy_from(tensors: dict[str, Float32Array], data: dict[str, Any]) -> QPolicy:
    kind = data["kind"]
    if kind not in KINDS:
        raise PolicyError(f"kind {kind!r}, allowed {', '.join(KINDS)}")
    params = params_of(data)
    layers = _count(data["network"], "layers", 1, LAYERS_MAX)
    names = {f"layer{n}.{part}" for n in range(layers) for part in ("weight", "bias")}
    if set(tensors) != names:
        raise PolicyError(f"tensors {sorted(tensors)}, expected {sorted(names)}")
    activation = data["network"]["activation"]
    if activation not in ("relu", "tanh"):
        raise PolicyError(f"activation {activation!r}, allowed relu, tanh")
    return QPolicy(
        name=kind,
        spec=ObservationSpec.from_json(data["observation"]),
        params=params,
        reward=RewardConfig(**data["reward"]),
        net=network_of(tensors, layers, activation),
        scaling=Normalisation(**data["normalisation"]),
        gamma=float(data["gamma"]),
        actions=_count(data, "actions", ACTIONS_MIN, ACTIONS_MAX),
        metadata=data,
    )


def _count(data: dict[str, Any], name: str, least: int, most: int) -> int:
    """A declared size: bounded, because arrays are made to it before anything else is checked."""
    value = data[name]
    if type(value) is not int or not least <= value <= most:
        raise PolicyError(f"{name}: {reprlib.repr(value)}, allowed whole numbers {least}..{most}")
    return value
