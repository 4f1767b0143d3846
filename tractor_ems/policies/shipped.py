"""The policies that ship with the package, by the powertrain they were made for. No training,
no YAML: a node finds its policy with this."""

from pathlib import Path

from tractor_msgs_py.errors import PolicyError
from tractor_sim.resources import resource_path


def shipped_policy(powertrain: str) -> Path:
    """The shipped policy file of a powertrain.

    Args:
        powertrain: its name. Settings changed behind a colon are left out: whether the policy
            may drive such a powertrain is decided by its hash.

    Raises:
        PolicyError: none ships for it.
    """
    files = {path.stem: path for path in resource_path("data", "policy").glob("*.safetensors")}
    name = powertrain.split(":")[0]
    if name not in files:
        raise PolicyError(
            f"policy default: none ships for powertrain {powertrain!r}, only for "
            f"{', '.join(sorted(files))}"
        )
    return files[name]
