"""Listed cycles by name, and new ones of a known operation by seed.

What a cycle may be used for stands in config/cycle/splits.yaml; the demand is computed from the
seed each time, so a name is all that has to be kept.
"""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from tractor_msgs_py.errors import ConfigError, CycleError
from tractor_sim.config import describe
from tractor_sim.duty_cycle.cycle import DutyCycle, Split
from tractor_sim.duty_cycle.cycle_csv import read_cycle_csv
from tractor_sim.duty_cycle.planter import PlanterParams, planter_demand_w
from tractor_sim.duty_cycle.published import published_cycle, published_operation
from tractor_sim.duty_cycle.splits import Listed, listed
from tractor_sim.resources import resource_path
from tractor_sim.yaml_file import read_yaml

Watt = Annotated[float, Field(ge=-1e9, le=1e9)]
Second = Annotated[int, Field(gt=0, le=1_000_000)]

PAPERS_PASS = "planter"
"""Name of the planter cycle that stands for the paper's."""


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
    start_max_w: Watt


class _Planter(BaseModel):
    model_config = ConfigDict(extra="forbid")
    operation: Literal["planter"]
    family: _Family
    paper_seed: Annotated[int, Field(ge=0)]


@lru_cache(maxsize=1)
def _planter() -> _Planter:
    path = resource_path("config", "cycle", "planter.yaml")
    try:
        return _Planter.model_validate(read_yaml(path))
    except ValidationError as error:
        raise ConfigError(f"{path}: {describe(error)}") from None


@lru_cache(maxsize=1)
def _by_name() -> dict[str, Listed]:
    """Every listed cycle; the paper's pass under its own name, and first."""
    paper_seed = _planter().paper_seed
    rows: dict[str, Listed] = {}
    for row in listed():
        if row.seed is None:
            rows[row.name] = replace(row, operation=published_operation(row.name))
        elif row.operation == "planter" and row.seed == paper_seed:
            rows = {PAPERS_PASS: replace(row, name=PAPERS_PASS), **rows}
        else:
            rows[row.name] = row
    held_out = {row.operation for row in rows.values() if row.split == "held_out"}
    for row in rows.values():
        if row.split != "held_out" and row.operation in held_out:
            raise ConfigError(
                f"config/cycle/splits.yaml: {row.name} is {row.split}, its operation "
                f"{row.operation} is held out and is allowed no other split"
            )
    return rows


def listed_cycles(split: Split | None = None, operation: str | None = None) -> list[Listed]:
    """The listed cycles, of one split or operation or of all, in a fixed order."""
    return [
        row
        for row in _by_name().values()
        if split in (None, row.split) and operation in (None, row.operation)
    ]


def cycle_names(split: Split | None = None) -> list[str]:
    """Names of the listed cycles, of one split or of all, in a fixed order."""
    return [row.name for row in listed_cycles(split)]


def operations() -> tuple[str, ...]:
    """Names of the operations that :func:`generate_cycle` knows."""
    from tractor_sim.duty_cycle.generate import MEASURED_JOBS, OPERATIONS

    return ("planter", *OPERATIONS, *MEASURED_JOBS)


def load_cycle(name_or_path: str | Path) -> DutyCycle:
    """A listed cycle by name, or a CSV file by path (see ``read_cycle_csv``).

    Raises:
        CycleError: no such cycle, or the file is malformed.
    """
    text = str(name_or_path)
    if text.endswith(".csv"):
        return read_cycle_csv(Path(text))
    row = _by_name().get(text)
    if row is None and text.startswith("planter_") and text[8:] == str(_planter().paper_seed):
        row = replace(_by_name()[PAPERS_PASS], name=text)
    if row is None:
        raise CycleError(_unknown(text))
    if row.seed is None:
        return published_cycle(row.name, row.split)
    cycle = _generated(row.operation, row.seed)
    return replace(
        cycle, name=row.name, split=row.split, power_demand_w=cycle.power_demand_w.copy()
    )


def generate_cycle(
    operation: str, seed: int, *, duration_s: int | None = None, depth_cm: float | None = None
) -> DutyCycle:
    """The cycle of one seed of an operation, listed or not.

    Args:
        operation: one of :func:`operations`.
        seed: 0 or more; the same seed gives the same bytes.
        duration_s: None: the operation's own.
        depth_cm: working depth of tillage; None: drawn from the seed.

    Returns:
        A cycle named ``operation_seed``, its split None. Demand is in whole watts (except the
        planter family's, whose bytes the shipped policy's training set names): the last bit of a
        computed float depends on processor and library, a rounded watt does not.

    Raises:
        CycleError: unknown operation, or a length or depth that it cannot have.
    """
    if operation == "planter":
        if duration_s is not None or depth_cm is not None:
            raise CycleError("operation planter: has one length and no depth, neither can be set")
        return _planter_cycle(seed)
    if operation not in operations():
        raise CycleError(f"operation {operation!r}: unknown, one of {', '.join(operations())}")
    from tractor_sim.duty_cycle.generate import generate

    length = {} if duration_s is None else {"duration_s": duration_s}
    cycle = generate(operation, seed, depth_cm=depth_cm, **length)
    return replace(cycle, power_demand_w=np.round(cycle.power_demand_w) + 0.0)


@lru_cache(maxsize=512)
def _generated(operation: str, seed: int) -> DutyCycle:
    return generate_cycle(operation, seed)


def _planter_cycle(seed: int) -> DutyCycle:
    family = _planter().family
    return DutyCycle(
        name=f"planter_{seed}",
        power_demand_w=planter_demand_w(PlanterParams(**family.model_dump()), seed),
        dt_s=family.dt_s,
        operation="planter",
        seed=seed,
        source="planter family calibrated to the paper's tables, config/cycle/planter.yaml",
    )


def _unknown(name: str) -> str:
    """Why there is no such cycle: its operation's listed seeds, or what is listed at all."""
    operation = name.rpartition("_")[0]
    seeds = [row.seed for row in listed_cycles(operation=operation) if row.seed is not None]
    if seeds:
        return (
            f"cycle {name!r}: unknown, listed are {operation}_{min(seeds)}..{operation}_"
            f"{max(seeds)} (ems cycle list); other seeds: ems cycle generate {operation}"
        )
    known = dict.fromkeys(
        row.name if row.seed is None or row.name == PAPERS_PASS else f"{row.operation}_SEED"
        for row in _by_name().values()
    )
    return f"cycle {name!r}: unknown, listed are {', '.join(known)}; or give a CSV file or a bag"
