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


def params_to_json(params: PowertrainParams) -> dict[str, Any]:
    """Plain data; an absent ramp limit is null, because JSON has no infinity."""
    data = dataclasses.asdict(params)
    if math.isinf(params.engine.ramp_w_per_s):
        data["engine"]["ramp_w_per_s"] = None
    return data


def params_from_json(data: dict[str, Any]) -> PowertrainParams:
    """Inverse of :func:`params_to_json`.

    Raises:
        ConfigError: a field is missing, unknown, mistyped or out of range.
    """
    try:
        engine = dict(data["engine"])
        if engine.get("ramp_w_per_s") is None:
            engine["ramp_w_per_s"] = math.inf
        engine = {key: _number(value) for key, value in engine.items()}
        generator = {key: _number(value) for key, value in data["generator"].items()}
        battery = {key: _number(value) for key, value in data["battery"].items()}
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
    if isinstance(value, list | tuple):
        return tuple(float(item) for item in value)
    return float(value)


def powertrain_hash(params: PowertrainParams) -> str:
    """SHA-256 of the canonical JSON of the parameters."""
    text = json.dumps(params_to_json(params), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()
