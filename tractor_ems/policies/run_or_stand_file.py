"""The policy that runs or stands as a file of kind ``ddqn_run_or_stand``; see ``run_or_stand``."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from tractor_ems.policies.mlp import Float32Array
from tractor_ems.policies.policy_file import network_of, params_of, write_policy_file
from tractor_ems.policies.q_policy import Normalisation
from tractor_ems.policies.run_or_stand import Prices, RunOrStand
from tractor_msgs_py.errors import PolicyError
from tractor_msgs_py.observation import ObservationSpec
from tractor_sim.powertrain_json import params_to_json, powertrain_hash

KIND = "ddqn_run_or_stand"
LAYERS = 3
"""Of every network: the compiled loop that scores them has two hidden ones."""

NETS_MAX = 16


def save_run_or_stand(path: Path, policy: RunOrStand) -> None:
    """Write a policy file, whole or not at all; equal policies give equal bytes.

    Raises:
        PolicyError: a weight is not finite.
        ConfigError: the folder cannot be written to.
    """
    tensors = {}
    for n, net in enumerate(policy.nets):
        for layer, (weight, bias) in enumerate(zip(net.weights, net.biases, strict=True)):
            tensors[f"net{n}.layer{layer}.weight"] = weight
            tensors[f"net{n}.layer{layer}.bias"] = bias
    metadata = {
        **policy.metadata,
        "kind": KIND,
        "name": policy.name,
        "observation": policy.spec.to_json(),
        "powertrain": params_to_json(policy.params),
        "powertrain_hash": powertrain_hash(policy.params),
        "normalisation": asdict(policy.scaling),
        "networks": len(policy.nets),
        "prices": asdict(policy.prices),
        "horizon_s": policy.horizon_s,
    }
    write_policy_file(path, tensors, metadata)


def run_or_stand_from(tensors: dict[str, Float32Array], data: dict[str, Any]) -> RunOrStand:
    """A policy of a file's tensors and metadata.

    Raises:
        PolicyError: tensors or metadata are not what :func:`save_run_or_stand` writes.
        ConfigError: damaged powertrain parameters.
    """
    count = data["networks"]
    if type(count) is not int or not 1 <= count <= NETS_MAX:
        raise PolicyError(f"networks: {count!r}, allowed whole numbers 1..{NETS_MAX}")
    layers = [(n, k) for n in range(count) for k in range(LAYERS)]
    names = {f"net{n}.layer{k}.{part}" for n, k in layers for part in ("weight", "bias")}
    if set(tensors) != names:
        raise PolicyError(f"tensors {sorted(tensors)}, expected {sorted(names)}")
    policy = RunOrStand(
        params=params_of(data),
        spec=ObservationSpec.from_json(data["observation"]),
        nets=tuple(network_of(tensors, LAYERS, "tanh", f"net{n}.") for n in range(count)),
        scaling=Normalisation(**data["normalisation"]),
        prices=Prices(**data["prices"]),
        horizon_s=float(data["horizon_s"]),
        metadata=data,
    )
    if policy.spec.dt_s != policy.params.dt_s:
        raise PolicyError(
            f"observation dt_s {policy.spec.dt_s}, the powertrain's is {policy.params.dt_s}"
        )
    if data["name"] != policy.name:
        raise PolicyError(f"name {data['name']!r}, with this horizon_s it is {policy.name}")
    return policy
