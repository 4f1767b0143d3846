"""Stochastic dynamic programming's table as a policy file, of kind ``sdp``; see ``sdp``."""

from pathlib import Path
from typing import Any

import numpy as np

from tractor_ems.policies.mlp import Float32Array
from tractor_ems.policies.policy_file import params_of, write_policy_file
from tractor_ems.policies.sdp import SdpPolicy
from tractor_msgs_py.errors import PolicyError
from tractor_msgs_py.observation import ObservationSpec
from tractor_sim.powertrain_json import params_to_json, powertrain_hash

KIND = "sdp"
NAMES = ("sdp", "sdp_unplanned")
"""What such a policy may be called: with and without a planned end."""


def save_sdp(path: Path, policy: SdpPolicy) -> None:
    """Write a policy file, whole or not at all; equal policies give equal bytes.

    Raises:
        PolicyError: a value is not finite.
        ConfigError: the folder cannot be written to.
    """
    tensors = {
        "value_kg": policy.value_kg.astype(np.float32),
        "number": policy.number.astype(np.float32),  # whole, far below 2^24
    }
    metadata = {
        **policy.metadata,
        "kind": KIND,
        "name": policy.name,
        "observation": policy.spec.to_json(),
        "powertrain": params_to_json(policy.params),
        "powertrain_hash": powertrain_hash(policy.params),
        "edges_w": [inner.tolist() for inner in policy.edges],
        "times_s": policy.times_s.tolist(),
        "offset": policy.offset.tolist(),
        "price_kg": policy.price_kg,
        "start_kg": policy.start_kg,
        "gamma": policy.gamma,
    }
    write_policy_file(path, tensors, metadata)


def sdp_from(tensors: dict[str, Float32Array], data: dict[str, Any]) -> SdpPolicy:
    """A policy of a file's tensors and metadata.

    Raises:
        PolicyError: tensors or metadata are not what :func:`save_sdp` writes.
        ConfigError: damaged powertrain parameters.
    """
    if set(tensors) != {"value_kg", "number"}:
        raise PolicyError(f"tensors {sorted(tensors)}, expected number, value_kg")
    if data["name"] not in NAMES:
        raise PolicyError(f"name {data['name']!r}, allowed {', '.join(NAMES)}")
    spec = ObservationSpec.from_json(data["observation"])
    params = params_of(data)
    if spec.dt_s != params.dt_s:
        raise PolicyError(f"observation dt_s {spec.dt_s}, the powertrain's is {params.dt_s}")
    number = tensors["number"].astype(np.int64)
    if number.ndim != 1 or not len(number) or number.min() < 0:
        raise PolicyError("number: must be situations 0, 1, ...")
    scalars = {name: float(data[name]) for name in ("price_kg", "start_kg", "gamma")}
    if not all(np.isfinite(value) for value in scalars.values()):
        raise PolicyError("price_kg, start_kg, gamma: must be finite")
    return SdpPolicy(
        params=params,
        filters=spec.filters,
        edges=tuple(np.array(inner, dtype=np.float64) for inner in data["edges_w"]),
        number=number,
        times_s=np.array(data["times_s"], dtype=np.float64),
        offset=np.array(data["offset"], dtype=np.float64),
        value_kg=tensors["value_kg"].astype(np.float64),
        name=data["name"],
        metadata=data,
        **scalars,
    )
