"""Shipped cycles by name, and which of them training may touch."""

from functools import lru_cache
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from tractor_msgs_py.errors import ConfigError, CycleError
from tractor_sim.config import describe
from tractor_sim.duty_cycle.cycle import DutyCycle, Split, read_cycle_csv
from tractor_sim.duty_cycle.planter import PlanterParams, planter_demand_w
from tractor_sim.resources import resource_path
from tractor_sim.yaml_file import read_yaml

Watt = Annotated[float, Field(ge=-1e9, le=1e9)]
Second = Annotated[int, Field(gt=0, le=1_000_000)]
SeedRange = tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]]


class _Family(BaseModel):
    model_config = ConfigDict(extra="forbid")
    duration_s: Second
    dt_s: Annotated[float, Field(gt=0, le=60)]
    mean_w: Watt
    pass_mean_w: Watt
    pass_scale_w: Watt
    ar_coefficient: Annotated[float, Field(ge=0, lt=1)]
    ar_innovation_sd: Annotated[float, Field(gt=0, le=100)]
    turn_duration_s: Second
    turn_period_min_s: Second
    turn_period_max_s: Second
    turn_mean_w: Watt
    turn_sd_w: Watt
    clip_min_w: Watt
    clip_max_w: Watt


class _Planter(BaseModel):
    model_config = ConfigDict(extra="forbid")
    operation: Literal["planter"]
    family: _Family
    paper_seed: Annotated[int, Field(ge=0)]
    seeds: dict[Split, SeedRange]


@lru_cache(maxsize=1)
def _planter() -> _Planter:
    path = resource_path("config", "cycle", "planter.yaml")
    try:
        return _Planter.model_validate(read_yaml(path))
    except ValidationError as error:
        raise ConfigError(f"{path}: {describe(error)}") from None


def cycle_names(split: Split | None = None) -> list[str]:
    """Names of the shipped cycles, of one split or of all, in a fixed order."""
    names = ["planter"] if split in (None, "train") else []
    for name, (first, last) in _planter().seeds.items():
        if split in (None, name):
            names += [f"planter_{s}" for s in range(first, last + 1) if s != _planter().paper_seed]
    return names


def load_cycle(name_or_path: str | Path) -> DutyCycle:
    """A shipped cycle by name, or a CSV file by path (see ``read_cycle_csv``).

    Raises:
        CycleError: no such cycle, or the file is malformed.
    """
    text = str(name_or_path)
    if text.endswith(".csv"):
        return read_cycle_csv(Path(text))
    config = _planter()
    seed, split = _seed_of(text, config)
    return DutyCycle(
        name=text,
        power_demand_w=planter_demand_w(PlanterParams(**config.family.model_dump()), seed),
        dt_s=config.family.dt_s,
        operation="planter",
        split=split,
        seed=seed,
        source="planter family calibrated to the paper's tables, config/cycle/planter.yaml",
    )


def _seed_of(name: str, config: _Planter) -> tuple[int, Split]:
    if name == "planter":
        return config.paper_seed, "train"
    operation, _, digits = name.rpartition("_")
    if operation == "planter" and digits.isdigit():
        for split, (first, last) in config.seeds.items():
            if first <= int(digits) <= last:
                return int(digits), split
    ranges = ", ".join(f"planter_{a}..planter_{b}" for a, b in config.seeds.values())
    raise CycleError(f"cycle {name!r}: unknown, shipped are planter, {ranges}; or give a CSV file")
