"""Powertrain parameters as plain JSON data, and their hash.

Separate from ``config`` because a policy node reads parameters out of a policy file without
loading the YAML and validation libraries.
"""

import dataclasses
import hashlib
import json
import math
from typing import Any

from tractor_msgs_py.errors import ConfigError
from tractor_sim.battery import BatteryParams
from tractor_sim.engine import EngineParams
from tractor_sim.generator import GeneratorParams
from tractor_sim.powertrain import PowertrainParams

_LATER: dict[str, dict[str, Any]] = {
    "engine": {"curve_fuel_kg_per_s": ()},
    "battery": {
        "ocv_soc": (),
        "ocv_v": (),
        "resistance_ohm": 0.0,
        "current_max_charge_a": math.inf,
        "current_max_discharge_a": math.inf,
    },
}
"""Fields that the first version did not have, with what it meant: left out where they hold that,
so that a powertrain keeps its hash, and recorded bags and trained policies their powertrain."""

_UNLIMITED = {
    "engine": ("ramp_w_per_s",),
    "battery": ("current_max_charge_a", "current_max_discharge_a"),
}


def params_to_json(params: PowertrainParams) -> dict[str, Any]:
    """Plain data; an absent limit is null, because JSON has no infinity."""
    data = dataclasses.asdict(params)
    for part, fields in _LATER.items():
        for field, meaning in fields.items():
            if data[part][field] == meaning:
                del data[part][field]
    for part, names in _UNLIMITED.items():
        for name in names:
            if data[part].get(name) == math.inf:
                data[part][name] = None
    return data


def params_from_json(data: dict[str, Any]) -> PowertrainParams:
    """Inverse of :func:`params_to_json`.

    Raises:
        ConfigError: a field is missing, unknown, mistyped or out of range.
    """
    try:
        engine, generator, battery = (
            {key: _number(value) for key, value in data[part].items()}
            for part in ("engine", "generator", "battery")
        )
        target = data.get("soc_target")
        return PowertrainParams(
            name=str(data["name"]),
            engine=EngineParams(**engine),
            generator=GeneratorParams(**generator),
            battery=BatteryParams(**battery),
            p_aux_w=float(data["p_aux_w"]),
            dt_s=float(data["dt_s"]),
            soc_initial=float(data["soc_initial"]),
            soc_target=None if target is None else float(target),
        )
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise ConfigError(f"powertrain: {error!r}") from None


def _number(value: Any) -> Any:
    if value is None:
        return math.inf
    if isinstance(value, list | tuple):
        return tuple(float(item) for item in value)
    return float(value)


def powertrain_hash(params: PowertrainParams) -> str:
    """SHA-256 of the canonical JSON of the parameters."""
    text = json.dumps(params_to_json(params), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()
