"""Schema of config/cycle/operations.yaml: every number of the generator, checked on reading."""

from collections.abc import Mapping
from functools import lru_cache
from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from tractor_msgs_py.errors import ConfigError
from tractor_sim.config import describe
from tractor_sim.duty_cycle.field_work.draft import draft_table
from tractor_sim.resources import resource_path
from tractor_sim.yaml_file import read_yaml

Texture = Literal["fine", "medium", "coarse"]
Positive = Annotated[float, Field(gt=0, le=1e9)]
NotNegative = Annotated[float, Field(ge=0, le=1e9)]
Share = Annotated[float, Field(ge=0, le=1)]
Efficiency = Annotated[float, Field(gt=0, le=1)]
Lag1 = Annotated[float, Field(ge=0, le=0.98)]


def _ordered(pair: tuple[float, float]) -> tuple[float, float]:
    if pair[0] > pair[1]:
        raise ValueError("lowest before highest")
    return pair


Range = Annotated[tuple[NotNegative, NotNegative], AfterValidator(_ordered)]
"""Lowest and highest of a uniform draw."""


PositiveRange = Annotated[tuple[Positive, Positive], AfterValidator(_ordered)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Vehicle(_Strict):
    """The tractor that works, and what its driver holds it to."""

    rated_power_w: Positive
    weight_kg: Positive
    slip_max: Annotated[float, Field(gt=0, le=0.3)]
    motor_power_w: Positive
    motor_load_fraction: tuple[Share, ...]
    motor_efficiency: tuple[Efficiency, ...]
    gear_efficiency: Efficiency
    pto_efficiency: Efficiency
    hydraulic_efficiency: Efficiency
    generator_efficiency: Efficiency
    regeneration_max_w: NotNegative
    idle_w: NotNegative
    cap_w: Positive
    sample_max_w: Positive
    mean_max_w: Positive
    mean_window_s: Annotated[int, Field(ge=1)]

    @model_validator(mode="after")
    def _curve_has_pairs(self) -> "Vehicle":
        load, efficiency = self.motor_load_fraction, self.motor_efficiency
        if len(load) != len(efficiency) or len(load) < 2 or list(load) != sorted(set(load)):
            raise ValueError("motor curve: two or more pairs, load_fraction increasing")
        return self


class Turn(_Strict):
    """Headland turns."""

    duration_s: PositiveRange
    duration_sd_s: NotNegative
    speed_km_h: PositiveRange
    hydraulic_w: NotNegative
    steering_w: NotNegative
    noise_sd: NotNegative
    noise_lag1: Lag1


class WithinPass(_Strict):
    """Noise of power within a pass, as a fraction of its level."""

    noise_sd: NotNegative
    noise_lag1: Lag1
    speed_up_m_per_s2: Positive
    slow_down_m_per_s2: Positive
    speed_sd: NotNegative
    level_sd: NotNegative


class Stop(_Strict):
    """Stands at pass ends: after every ``every_m`` of work, or at a ``chance`` per turn."""

    every_m: Range = (0.0, 0.0)
    chance: Share = 0.0
    duration_s: Range
    power_w: NotNegative


class Pto(_Strict):
    """PTO power = idle_w + energy per crop mass x throughput, at the shaft."""

    idle_w: NotNegative
    energy_j_per_kg: Positive
    crop_kg_per_m2: Range
    crop_sd: NotNegative
    crop_patch_m: Positive


class Plunger(_Strict):
    """Strokes of a baler: power swings by ``swing`` of the crop power at ``frequency_hz``."""

    frequency_hz: PositiveRange
    swing: NotNegative


class FieldWork(_Strict):
    """Work in passes across a field."""

    kind: Literal["field"]
    d497: str | None = None
    units: Annotated[tuple[Positive, ...], Field(min_length=1)]
    unit_width_m: Positive
    overlap: Share
    speed_km_h: PositiveRange
    depth_cm: Range | None = None
    depth_allowed_cm: Range | None = None
    textures: Annotated[tuple[Texture, ...], Field(min_length=1)] = ("medium",)
    wheel_numeric: PositiveRange
    ballast_kg: Annotated[float, Field(ge=-5e3, le=2e4)]
    implement_kg: NotNegative
    cart_kg: NotNegative = 0.0
    rolling: Share
    field_length_m: PositiveRange
    grade_max: Annotated[float, Field(ge=0, le=0.3)]
    soil_sd: NotNegative
    soil_patch_m: Positive
    engage_m: Positive
    hydraulic_w: NotNegative = 0.0
    pto: Pto | None = None
    plunger: Plunger | None = None
    mid_pass_stop: Stop | None = None
    refill: Stop | None = None
    wait: Stop | None = None


class Loader(_Strict):
    """Short loading cycles."""

    kind: Literal["loader"]
    weight_kg: Positive
    payload_kg: Range
    approach_m: PositiveRange
    haul_m: PositiveRange
    speed_km_h: PositiveRange
    speed_up_m_per_s2: Positive
    rolling: Share
    dig_s: PositiveRange
    power_max_w: Positive
    dig_force_n: Range
    dig_speed_km_h: Positive
    lift_height_m: Range
    boom_kg: NotNegative
    oil_efficiency: Efficiency
    tilt_hydraulic_w: NotNegative
    dump_s: Range
    trucks_every_cycles: Annotated[tuple[int, int], Field()]
    wait_s: Range
    idle_w: NotNegative
    noise_sd: NotNegative
    noise_lag1: Lag1


class Road(_Strict):
    """Transport with a trailer."""

    kind: Literal["road"]
    weight_kg: PositiveRange
    speed_km_h: PositiveRange
    section_m: PositiveRange
    stop_chance: Share
    stop_s: Range
    rolling: Share
    drag_area_m2: Positive
    speed_up_m_per_s2: Positive
    slow_down_m_per_s2: Positive
    grade_max: Annotated[float, Field(ge=0, le=0.15)]
    wave_m: PositiveRange
    idle_w: NotNegative
    noise_sd: NotNegative
    noise_lag1: Lag1


class Part(_Strict):
    """One stretch of a mixed day: any of ``operations``, a share of the time."""

    operations: tuple[str, ...]
    share: Range


class Mixed(_Strict):
    """A day of different work in the time of one cycle."""

    kind: Literal["mixed"]
    idle_w: NotNegative
    parts: tuple[Part, ...]


class MeasuredJob(_Strict):
    """Pass and turn pattern of one measured job; powers in fractions of rated power.

    Blocks of regular passes and turns alternate with irregular work (short pieces and idling).
    """

    kind: Literal["measured"]
    passes_per_block: Annotated[tuple[int, int], Field()]
    pass_s: tuple[Positive, Positive]
    turn_s: tuple[Positive, Positive]
    level: tuple[Positive, Positive]
    noise_sd: NotNegative
    noise_lag1: Lag1
    onset_s: tuple[float, NotNegative]
    late_chance: Share
    late_s: Range
    rise_per_s: PositiveRange
    fall_per_s: PositiveRange
    end_lag_s: tuple[float, NotNegative]
    turn_level: tuple[Share, Share, Share]
    turn_noise_sd: NotNegative
    turn_noise_lag1: Lag1
    pieces_per_block: Annotated[tuple[int, int], Field()]
    piece_s: Range
    piece_level: Range
    piece_gap_s: Range
    idle_chance: Share
    idle_s: Range
    idle_level: NotNegative


class Operations(_Strict):
    """The whole file."""

    vehicle: Vehicle
    turn: Turn
    within_pass: WithinPass
    operations: dict[
        str,
        Annotated[FieldWork | Loader | Road | Mixed | MeasuredJob, Field(discriminator="kind")],
    ]


@lru_cache(maxsize=1)
def operations() -> Operations:
    """The shipped parameters.

    Raises:
        ConfigError: the file breaks its schema; names file, field and value.
    """
    path = resource_path("config", "cycle", "operations.yaml")
    try:
        checked = Operations.model_validate(read_yaml(path))
    except ValidationError as error:
        raise ConfigError(f"{path}: {describe(error)}") from None
    for name, work in checked.operations.items():
        problem = _unknown_name(work, checked.operations)
        if problem is not None:
            raise ConfigError(f"{path}: operations.{name}.{problem}")
    return checked


def _unknown_name(work: object, known: Mapping[str, object]) -> str | None:
    """What a piece of work refers to and is not there, in words."""
    if isinstance(work, FieldWork) and work.d497 is not None and work.d497 not in draft_table():
        return f"d497: {work.d497!r} is not in the table, one of {', '.join(draft_table())}"
    if isinstance(work, Mixed):
        for name in (name for part in work.parts for name in part.operations):
            if name not in known or isinstance(known[name], Mixed):
                return f"parts: {name!r} is no single operation of this file"
    return None
