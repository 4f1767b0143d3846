"""The sampled policy over knots of engine power as a file of kind ``ddqn_sampled_knots``."""

import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

from tractor_ems.policies.knot_q import KnotQ, Measured
from tractor_ems.policies.mlp import Float32Array
from tractor_ems.policies.policy_file import network_of, params_of, write_policy_file
from tractor_ems.policies.q_policy import LAYERS_MAX, Normalisation
from tractor_msgs_py.errors import PolicyError
from tractor_msgs_py.observation import ObservationSpec
from tractor_sim.powertrain_json import params_to_json, powertrain_hash

KIND = "ddqn_sampled_knots"


def save_knot_q(path: Path, policy: KnotQ) -> None:
    """Write a policy file, whole or not at all; equal policies give equal bytes.

    Raises:
        PolicyError: a weight is not finite.
        ConfigError: the folder cannot be written to.
    """
    tensors = {}
    pairs = zip(policy.net.weights, policy.net.biases, strict=True)
    for layer, (weight, bias) in enumerate(pairs):
        tensors[f"layer{layer}.weight"] = weight
        tensors[f"layer{layer}.bias"] = bias
    metadata = {
        **policy.metadata,
        "kind": KIND,
        "observation": policy.spec.to_json(),
        "powertrain": params_to_json(policy.params),
        "powertrain_hash": powertrain_hash(policy.params),
        "normalisation": asdict(policy.scaling),
        "network": {"layers": len(policy.net.weights), "activation": policy.net.activation},
        "horizon_s": policy.horizon_s,
        "measured": asdict(policy.measured),
        "start_units": policy.start_units,
    }
    write_policy_file(path, tensors, metadata)


def knot_q_from(tensors: dict[str, Float32Array], data: dict[str, Any]) -> KnotQ:
    """A policy of a file's tensors and metadata.

    Raises:
        PolicyError: tensors or metadata are not what :func:`save_knot_q` writes.
        ConfigError: damaged powertrain parameters.
    """
    layers, activation = data["network"]["layers"], data["network"]["activation"]
    if type(layers) is not int or not 1 <= layers <= LAYERS_MAX:
        raise PolicyError(f"network.layers: {layers!r}, allowed whole numbers 1..{LAYERS_MAX}")
    if activation not in ("relu", "tanh"):
        raise PolicyError(f"network.activation: {activation!r}, allowed relu, tanh")
    names = {f"layer{n}.{part}" for n in range(layers) for part in ("weight", "bias")}
    if set(tensors) != names:
        raise PolicyError(f"tensors {sorted(tensors)}, expected {sorted(names)}")
    policy = KnotQ(
        params=params_of(data),
        spec=ObservationSpec.from_json(data["observation"]),
        net=network_of(tensors, layers, activation),
        scaling=Normalisation(**data["normalisation"]),
        horizon_s=float(data["horizon_s"]),
        measured=_measured(data["measured"]),
        start_units=float(data["start_units"]),
        metadata=data,
    )
    if policy.spec.dt_s != policy.params.dt_s:
        raise PolicyError(
            f"observation dt_s {policy.spec.dt_s}, the powertrain's is {policy.params.dt_s}"
        )
    return policy


def _measured(data: dict[str, Any]) -> Measured:
    fuel_kg = tuple(float(value) for value in data["fuel_kg"])
    first, second, third = (float(value) for value in data["soc_fit"])
    price_kg, unit_kg = float(data["price_kg"]), float(data["unit_kg"])
    if not all(math.isfinite(v) for v in (*fuel_kg, first, second, third, price_kg, unit_kg)):
        raise PolicyError("measured: a value is not finite")
    return Measured(fuel_kg, (first, second, third), price_kg, unit_kg)
