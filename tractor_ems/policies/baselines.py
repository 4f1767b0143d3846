"""Baselines by name, with the settings that were tuned for a powertrain where it has a file
``config/baseline/NAME.yaml``, else with documented defaults. How they are tuned: ``ems tune``.
"""

import dataclasses
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tractor_ems.policies.a_ecms import AEcms
from tractor_ems.policies.ecms import NeverStopEcms
from tractor_ems.policies.levelling import LoadLevelling
from tractor_ems.policies.protocol import Policy
from tractor_msgs_py.errors import ConfigError, PolicyError
from tractor_sim.powertrain import PowertrainParams
from tractor_sim.resources import share_dir
from tractor_sim.yaml_file import read_yaml

BASELINES: dict[str, tuple[type[Any], Mapping[str, float], tuple[str, ...]]] = {
    "load_levelling": (
        LoadLevelling,
        {},
        ("mean_time_s", "soc_time_s", "least_share", "start_share", "stop_share"),
    ),
    "never_stop_ecms": (NeverStopEcms, {}, ("equivalence", "soc_gain")),
    "ecms": (AEcms, {"write_off_s": math.inf, "decide_s": 0.0}, ("equivalence", "soc_gain")),
    "a_ecms": (
        AEcms,
        {"stiffen_s": 100.0},
        ("equivalence", "soc_gain", "adapt", "write_off_s", "decide_s", "stiffen_s"),
    ),
    "a_ecms_unplanned": (
        AEcms,
        {},
        ("equivalence", "soc_gain", "adapt", "write_off_s", "decide_s"),
    ),
}
"""Name to what makes it, what of that the name fixes or defaults to, and what may be tuned.

``ecms`` is the classic one: free to stop, a start counts nothing, the present demand decides.
``a_ecms`` knows the planned end, ``a_ecms_unplanned`` does not.
"""

TUNED_ONLY = ("sdp", "sdp_unplanned")
"""Names that a file of settings may hold besides: policies that are fitted, not just made."""


def tuned_path(params: PowertrainParams) -> Path | None:
    """The file of settings tuned for a powertrain, by its name without changed settings; None
    where there is none."""
    name = params.name.partition(":")[0]
    if not re.fullmatch(r"[A-Za-z0-9_-]+", name):
        return None
    path = share_dir() / "config" / "baseline" / f"{name}.yaml"
    return path if path.is_file() else None


def read_tuned(path: Path) -> dict[str, dict[str, Any]]:
    """Settings by policy out of a file.

    Raises:
        ConfigError: it is not such a file; an unknown policy or setting; not a finite number.
    """
    document = read_yaml(path)
    policies = document.get("policies") if isinstance(document, Mapping) else None
    if not isinstance(policies, Mapping):
        raise ConfigError(f"{path}: no `policies` with settings by policy")
    found: dict[str, dict[str, Any]] = {}
    for name, settings in policies.items():
        if name not in (*BASELINES, *TUNED_ONLY):
            known = ", ".join((*BASELINES, *TUNED_ONLY))
            raise ConfigError(f"{path}: policies.{name}: unknown, allowed {known}")
        if not isinstance(settings, Mapping):
            raise ConfigError(f"{path}: policies.{name}: {settings!r}, allowed settings by name")
        found[name] = {}
        for key, value in settings.items():
            if name in BASELINES:
                value = _checked(f"{path}: policies.{name}", name, str(key), value)
            found[name][str(key)] = value
    return found


def _checked(where: str, name: str, key: str, value: Any) -> float:
    allowed = BASELINES[name][2]
    if key not in allowed:
        raise ConfigError(f"{where}.{key}: unknown, allowed {', '.join(allowed)}")
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ConfigError(f"{where}.{key}: {value!r}, allowed a finite number")
    return float(value)


def tuned_settings(name: str, params: PowertrainParams) -> dict[str, Any]:
    """Settings of one policy for a powertrain; empty where none were tuned.

    Raises:
        ConfigError: the file is not what :func:`read_tuned` reads.
    """
    path = tuned_path(params)
    return {} if path is None else read_tuned(path).get(name, {})


def make_baseline(
    name: str, params: PowertrainParams, settings: Mapping[str, Any] | None = None
) -> Policy:
    """One of :data:`BASELINES` with given settings, or with those tuned for the powertrain.

    Raises:
        PolicyError: no such baseline, or a setting out of range.
        ConfigError: an unknown setting, or a damaged file.
    """
    if name not in BASELINES:
        raise PolicyError(f"policy {name!r}: no baseline, they are {', '.join(BASELINES)}")
    make, fixed, _ = BASELINES[name]
    chosen = tuned_settings(name, params) if settings is None else settings
    checked = {key: _checked(name, name, key, value) for key, value in chosen.items()}
    policy: Policy = dataclasses.replace(make(params), **{**fixed, **checked, "name": name})
    return policy
