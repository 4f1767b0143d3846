"""Policies out of files, of every kind, for whoever drives or scores them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from tractor_ems.policies import knot_q_file, q_policy, run_or_stand_file, sdp_file
from tractor_ems.policies.envelope import stored_envelope
from tractor_ems.policies.mlp import Float32Array
from tractor_ems.policies.policy_file import read_policy
from tractor_ems.policies.protocol import MadePolicy
from tractor_msgs_py.errors import PolicyError
from tractor_sim.powertrain_json import powertrain_hash

MAKERS: dict[str, Callable[[dict[str, Float32Array], dict[str, Any]], MadePolicy]] = {
    **dict.fromkeys(q_policy.KINDS, q_policy.policy_from),
    run_or_stand_file.KIND: run_or_stand_file.run_or_stand_from,
    sdp_file.KIND: sdp_file.sdp_from,
    knot_q_file.KIND: knot_q_file.knot_q_from,
}
"""Kind of policy to what makes one of tensors and metadata."""


def load_made(path: str | Path) -> MadePolicy:
    """Read a policy file of any kind.

    Raises:
        PolicyError: the file is missing, cut short, not a policy file, of an unknown version or
            kind, damaged, or its tensors do not have the shapes its metadata promises.
    """
    return read_policy(Path(path), _made)


def _made(tensors: dict[str, Float32Array], metadata: dict[str, Any]) -> MadePolicy:
    kind = metadata["kind"]
    if kind not in MAKERS:
        raise PolicyError(f"kind {kind!r}, allowed {', '.join(MAKERS)}")
    stored_envelope(metadata)  # a damaged one is refused with the file's name
    return MAKERS[kind](tensors, metadata)


def check_powertrain(policy: MadePolicy, expected_hash: str) -> None:
    """Refuse a policy that was made for another powertrain.

    Raises:
        PolicyError: the hashes differ.
    """
    own = powertrain_hash(policy.params)
    if own != expected_hash:
        raise PolicyError(
            f"policy {policy.name} was made for powertrain {policy.params.name} "
            f"({own[:12]}), this one is {expected_hash[:12]}"
        )
