"""Stochastic dynamic programming's table as a policy file, of kind ``sdp``; see ``sdp``."""

from pathlib import Path
from typing import Any

import numpy as np

from tractor_ems.policies.mlp import Float32Array
from tractor_ems.policies.policy_file import params_of, write_policy_file
from tractor_ems.policies.sdp import SdpPolicy
from tractor_msgs_py.errors import PolicyError
from tractor_msgs_py.observation import ObservationSpec
from tractor_msgs_py.trajectory import FloatArray
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
    stored = tensors["number"]
    most = tensors["value_kg"].size
    if stored.ndim != 1 or not np.all((stored >= 0) & (stored < most) & (stored % 1 == 0)):
        raise PolicyError("number: must be situations 0, 1, ...")
    times_s, offset = _axis(data["times_s"], "times_s"), _axis(data["offset"], "offset")
    if not np.all(times_s >= 0.0):
        raise PolicyError(f"times_s: {times_s.min()}, must be >= 0")
    if (len(times_s) > 1) != (data["name"] == "sdp"):
        raise PolicyError(f"times_s: {len(times_s)} of them, which {data['name']} cannot have")
    widths = np.diff(offset)
    if not (np.all(np.abs(offset) <= 1.0) and np.allclose(widths, widths[:1], 1e-6, 0.0)):
        raise PolicyError("offset: must be evenly spaced within -1..1")
    if np.any(widths < 1e-6):
        raise PolicyError("offset: must rise by 1e-6 or more")
    scalars = {name: float(data[name]) for name in ("price_kg", "start_kg", "gamma")}
    for name, value in scalars.items():
        greatest = 1.0 if name == "gamma" else 1e6
        if not 0.0 <= value <= greatest:
            raise PolicyError(f"{name}: {value}, allowed 0..{greatest:g}")
    return SdpPolicy(
        params=params,
        filters=spec.filters,
        edges=tuple(_axis(inner, "edges_w") for inner in data["edges_w"]),
        number=stored.astype(np.int64),
        times_s=times_s,
        offset=offset,
        value_kg=tensors["value_kg"].astype(np.float64),
        name=data["name"],
        metadata=data,
        **scalars,
    )


def _axis(values: Any, name: str) -> FloatArray:
    axis = np.array(values, dtype=np.float64)
    if axis.ndim != 1:
        raise PolicyError(f"metadata {name}: shape {axis.shape}, must be one list of numbers")
    return axis
