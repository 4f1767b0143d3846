"""Powertrain YAML to parameters, and the hash that names a powertrain.

The schema refuses unknown keys; ranges are checked where the parameters are built, so a policy
file's embedded powertrain passes the same checks.
"""

from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from tractor_msgs_py.errors import ConfigError
from tractor_sim.powertrain import PowertrainParams
from tractor_sim.powertrain_json import params_from_json
from tractor_sim.resources import resource_path
from tractor_sim.yaml_file import read_yaml

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, le=1)]

_SHOWN = 80
"""Characters of a wrong value that an error message repeats."""


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class _Engine(_Strict):
    power_max_w: Positive
    fuel_lhv_j_per_kg: Positive
    curve_power_w: tuple[NotNegative, ...]
    curve_efficiency: tuple[Fraction, ...]
    idle_fuel_kg_per_s: NotNegative = 0.0
    start_fuel_kg: NotNegative = 0.0
    min_on_s: NotNegative = 0.0
    min_off_s: NotNegative = 0.0
    ramp_w_per_s: Positive | None = None


class _Generator(_Strict):
    load_fraction: tuple[Fraction, ...] = (0.0, 1.0)
    curve_efficiency: tuple[Fraction, ...] = (1.0, 1.0)


class _Battery(_Strict):
    energy_j: Positive
    voltage_v: Positive
    power_max_w: Positive
    soc_min: Fraction
    soc_max: Fraction


class _Powertrain(_Strict):
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]+$")]
    dt_s: Annotated[float, Field(gt=0, le=60, allow_inf_nan=False)]
    p_aux_w: NotNegative = 0.0
    soc_initial: Fraction
    soc_target: Fraction | None = None
    engine: _Engine
    generator: _Generator = _Generator()
    battery: _Battery


def load_powertrain(name_or_path: str | Path) -> PowertrainParams:
    """A powertrain by name (``config/powertrain/NAME.yaml``) or by YAML file.

    Raises:
        ConfigError: the file is missing, is not YAML, has an unknown key, or a value out of
            range; the message names the file, the field, the value and the allowed range.
    """
    path = _find(name_or_path)
    try:
        checked = _Powertrain.model_validate(read_yaml(path))
    except ValidationError as error:
        raise ConfigError(f"{path}: {describe(error)}") from None
    try:
        return params_from_json(checked.model_dump(mode="json"))
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def describe(error: ValidationError) -> str:
    """The first problem of a validation error in one line: field, problem, value."""
    first = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"]) or "document"
    more = error.error_count() - 1
    shown = _shown(first["input"])
    return f"{where}: {first['msg']} (got {shown})" + (f", {more} more" if more else "")


def _shown(value: object) -> str:
    try:
        text = repr(value)
    except ValueError:  # Python prints no integer of more than 4300 digits
        return "a number of thousands of digits"
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}..."


def _find(name_or_path: str | Path) -> Path:
    text = str(name_or_path)
    if text.endswith((".yaml", ".yml")) or "/" in text:
        path = Path(text)
        if not path.is_file():
            raise ConfigError(f"{path}: no such powertrain file")
        return path
    folder = resource_path("config", "powertrain")
    path = folder / f"{text}.yaml"
    if not path.is_file():
        known = ", ".join(sorted(item.stem for item in folder.glob("*.yaml")))
        raise ConfigError(f"powertrain {text!r}: unknown, shipped are: {known}")
    return path
