"""Powertrain YAML to parameters.

The schema refuses unknown keys; ranges are checked where the parameters are built, so a policy
file's embedded powertrain passes the same checks.
"""

import dataclasses
import re
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from tractor_msgs_py.errors import ConfigError
from tractor_sim.engine import check_fuel_knots
from tractor_sim.fuel_curve import convex_fuel_curve
from tractor_sim.generator import GeneratorParams
from tractor_sim.knots import check_entries, check_rising
from tractor_sim.powertrain import PowertrainParams
from tractor_sim.powertrain_json import params_from_json
from tractor_sim.resources import resource_path
from tractor_sim.yaml_file import read_yaml

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, le=1)]

_VALUE = re.compile(r"[+-]?([0-9]+[.]?[0-9]*|[.][0-9]+)([eE][+-]?[0-9]+)?|[A-Za-z][A-Za-z0-9_.-]*")
"""What may stand behind ``=`` in a changed setting."""

_SHOWN = 80
"""Characters of a wrong value that an error message repeats."""


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class _FuelCurve(_Strict):
    """Fuel rate while on at crankshaft powers, as measured or mapped."""

    power_w: Annotated[tuple[NotNegative, ...], Field(min_length=2)]
    fuel_kg_per_s: Annotated[tuple[NotNegative, ...], Field(min_length=2)]


class _Engine(_Strict):
    """Either an efficiency curve, or fuel curves of which ``curve`` names the one in use."""

    power_max_w: Positive
    fuel_lhv_j_per_kg: Positive
    curve_power_w: tuple[NotNegative, ...] = ()
    curve_efficiency: tuple[Fraction, ...] = ()
    curve: str = ""
    curves: dict[str, _FuelCurve] = {}
    idle_fuel_kg_per_s: NotNegative = 0.0
    start_fuel_kg: NotNegative = 0.0
    min_on_s: NotNegative = 0.0
    min_off_s: NotNegative = 0.0
    ramp_w_per_s: Positive | None = None


class _Generator(_Strict):
    load_fraction: tuple[Fraction, ...] = (0.0, 1.0)
    curve_efficiency: tuple[Annotated[float, Field(gt=0, le=1)], ...] = (1.0, 1.0)


class _Battery(_Strict):
    energy_j: Positive
    voltage_v: Positive
    power_max_w: Positive
    soc_min: Fraction
    soc_max: Fraction
    ocv_soc: tuple[Fraction, ...] = ()
    ocv_v: tuple[Positive, ...] = ()
    resistance_ohm: NotNegative = 0.0
    current_max_charge_a: Positive | None = None
    current_max_discharge_a: Positive | None = None


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

    Settings may be changed behind a colon, by their dotted names in the file:
    ``field:engine.start_fuel_kg=0.06,engine.curve=fixed_1800_rpm``. The powertrain is then
    called so.

    Raises:
        ConfigError: the file is missing, is not YAML, has an unknown key, or a value out of
            range; the message names the file, the field, the value and the allowed range.
    """
    text = str(name_or_path)
    found, document = read_powertrain(text)
    try:
        checked = _Powertrain.model_validate(document)
    except ValidationError as error:
        raise ConfigError(f"{found}: {describe(error)}") from None
    try:
        _check_curves(checked.engine)
        params = params_from_json(_resolved(checked.model_dump(mode="json")))
    except ConfigError as error:
        raise ConfigError(f"{found}: {error}") from None
    settings = "" if _is_file(text) else text.partition(":")[2]
    return dataclasses.replace(params, name=f"{params.name}:{settings}") if settings else params


def read_powertrain(name_or_path: str) -> tuple[str, Any]:
    """The raw document behind a name or file with its changed settings, and how errors name it.

    Raises:
        ConfigError: the file is missing or not YAML, or a setting is malformed.
    """
    base, _, settings = name_or_path.partition(":")
    if _is_file(name_or_path):
        base, settings = name_or_path, ""
    path = _find(base)
    document = read_yaml(path)
    if not settings:
        return str(path), document
    given: set[str] = set()
    for setting in settings.split(","):
        dotted, equals, value = setting.partition("=")
        *parents, last = dotted.split(".")
        place = document
        for parent in parents:
            place = place.get(parent) if isinstance(place, dict) else None
        if not (equals and last and isinstance(place, dict) and dotted not in given):
            raise ConfigError(
                f"powertrain {name_or_path!r}: {setting!r} is no setting of {path} or "
                "given twice, write for instance engine.start_fuel_kg=0.06"
            )
        given.add(dotted)
        if not _VALUE.fullmatch(value):
            raise ConfigError(
                f"powertrain {_shown(name_or_path)}: {_shown(value)} is no value of {dotted}, "
                "allowed a number, null or a name"
            )
        place[last] = None if value == "null" else _number_or_name(value)
    return f"{path}:{settings}", document


def _number_or_name(text: str) -> float | str:
    """No YAML: there yes is a truth value, 1:30 is ninety and 2023-13-01 an error."""
    try:
        return float(text)
    except ValueError:
        return text


def _check_curves(engine: _Engine) -> None:
    """What the schema cannot say of the curves, because it takes several fields to see it.

    Raises:
        ConfigError: the message names the field as the file does, its value and what is allowed.
    """
    plain = bool(engine.curve_power_w or engine.curve_efficiency)
    if bool(engine.curves) == plain:
        raise ConfigError(
            f"engine.curves, engine.curve_power_w: {'both' if plain else 'none'} given, allowed "
            "either curves or curve_power_w with curve_efficiency"
        )
    for name, curve in engine.curves.items():
        field = f"engine.curves.{name}"
        if len(curve.power_w) != len(curve.fuel_kg_per_s):
            raise ConfigError(
                f"{field}.power_w: {len(curve.power_w)} entries, allowed as many as "
                f"fuel_kg_per_s has, {len(curve.fuel_kg_per_s)}"
            )
        check_rising(f"{field}.power_w", curve.power_w)
    if plain:
        return
    if engine.curve not in engine.curves:
        names = ", ".join(engine.curves)
        raise ConfigError(f"engine.curve: {_shown(engine.curve)}, allowed {names}")
    _check_curve_in_use(engine, f"engine.curves.{engine.curve}", engine.curves[engine.curve])


def _check_curve_in_use(engine: _Engine, field: str, curve: _FuelCurve) -> None:
    """Refuse a fuel curve whose convex hull would not rise or would pass an efficiency of 1."""
    power_w, fuel = np.array(curve.power_w), np.array(curve.fuel_kg_per_s)
    if power_w[-1] != engine.power_max_w:
        raise ConfigError(
            f"{field}.power_w.{len(power_w) - 1}: {power_w[-1]}, allowed engine.power_max_w, "
            f"{engine.power_max_w}"
        )
    check_fuel_knots(f"{field}.fuel_kg_per_s", power_w, fuel, engine.fuel_lhv_j_per_kg)
    if power_w[0] > 0.0:
        idle = engine.idle_fuel_kg_per_s
        if idle >= fuel[0]:
            raise ConfigError(
                f"engine.idle_fuel_kg_per_s: {idle}, allowed 0 <= value < {fuel[0]}, "
                f"{field}.fuel_kg_per_s at its first power, {power_w[0]:g} W"
            )
    else:
        idle = float(fuel[0])
    above = fuel > idle
    above[0] = True
    check_entries(f"{field}.fuel_kg_per_s", fuel, above, f"> {idle}, the fuel rate at 0 W")


def _resolved(document: dict[str, Any]) -> dict[str, Any]:
    """The checked document in the terms of the parameters: the fuel curve in use, made convex."""
    engine = document["engine"]
    name, curves = engine.pop("curve"), engine.pop("curves")
    if curves:
        generator = GeneratorParams(**{k: tuple(v) for k, v in document["generator"].items()})
        knots_w, fuel_kg_per_s = convex_fuel_curve(
            generator,
            np.array(curves[name]["power_w"]),
            np.array(curves[name]["fuel_kg_per_s"]),
            engine["idle_fuel_kg_per_s"],
        )
        engine["curve_power_w"] = knots_w.tolist()
        engine["curve_fuel_kg_per_s"] = fuel_kg_per_s.tolist()
    return document


def describe(error: ValidationError) -> str:
    """One problem of a validation error in one line: field, problem, value.

    It is the first unknown key, which is often a missing one misspelt, or else the first problem.
    """
    problems = error.errors()
    unknown = (item for item in problems if item["type"] == "extra_forbidden")
    first = next(unknown, problems[0])
    where = ".".join(str(part) for part in first["loc"]) or "the document"
    more = error.error_count() - 1
    value, problem = first["input"], first["msg"].removeprefix("Value error, ")
    if first["type"] == "missing":
        text = f"{where}: is missing, a value is required"
    elif first["type"] in ("model_type", "dict_type"):
        got = "nothing" if value is None else _shown(value)
        text = f"{where}: {got}, allowed a mapping of names to values"
    elif first["type"] == "value_error" and isinstance(value, dict | BaseModel):
        text = f"{where}: {problem}"  # of several fields, which the problem names
    else:
        text = f"{where}: {problem} (got {_shown(value)})"
    return text + (f", {more} more" if more else "")


def _shown(value: object) -> str:
    try:
        text = repr(value)
    except ValueError:  # Python prints no integer of more than 4300 digits
        return "a number of thousands of digits"
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}..."


def _is_file(text: str) -> bool:
    try:
        return Path(text).is_file()
    except OSError:  # many settings are longer than a file name may be
        return False


def _find(name_or_path: str | Path) -> Path:
    text = str(name_or_path)
    if text.endswith((".yaml", ".yml")) or "/" in text:
        path = Path(text)
        if not _is_file(text):
            raise ConfigError(f"{path}: no such powertrain file")
        return path
    folder = resource_path("config", "powertrain")
    path = folder / f"{text}.yaml"
    if not _is_file(str(path)):
        known = ", ".join(sorted(item.stem for item in folder.glob("*.yaml")))
        raise ConfigError(f"powertrain {text!r}: unknown, shipped are: {known}")
    return path
