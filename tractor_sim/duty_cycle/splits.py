"""Which cycles are listed, and what each may be used for: config/cycle/splits.yaml, checked.

An operation whose cycles are held out has no other cycles, so nothing can be learnt about it.
"""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from tractor_msgs_py.errors import ConfigError
from tractor_sim.config import describe
from tractor_sim.duty_cycle.cycle import Split
from tractor_sim.resources import resource_path
from tractor_sim.yaml_file import read_yaml

Seed = Annotated[int, Field(ge=0, le=2**32 - 1)]
Name = Annotated[str, Field(pattern=r"^[a-z0-9_]+$")]
MAX_SEEDS = 10_000
"""Of one range; a list is for people to read."""


@dataclass(frozen=True)
class Listed:
    """One listed cycle: ``seed`` is None for a published one, whose name is its own."""

    name: str
    operation: str
    split: Split
    seed: int | None


class _Splits(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)
    operations: dict[Name, dict[Split, tuple[Seed, Seed]]]
    published: dict[Name, Split] = {}


def read_splits(path: Path) -> tuple[Listed, ...]:
    """The cycles that a splits file lists, in its order, the training split first.

    Raises:
        ConfigError: the file is malformed, a range is empty or overlaps another of its
            operation, or an operation is both held out and something else.
    """
    try:
        splits = _Splits.model_validate(read_yaml(path))
    except ValidationError as error:
        raise ConfigError(f"{path}: {describe(error)}") from None
    rows: list[Listed] = []
    for operation, ranges in splits.operations.items():
        _check(path, operation, ranges)
        for split, (first, last) in ranges.items():
            rows += [
                Listed(f"{operation}_{seed}", operation, split, seed)
                for seed in range(first, last + 1)
            ]
    rows += [Listed(name, name, split, None) for name, split in splits.published.items()]
    order = ("train", "validation", "held_out")
    return tuple(sorted(rows, key=lambda row: order.index(row.split)))


def _check(path: Path, operation: str, ranges: dict[Split, tuple[int, int]]) -> None:
    field = f"{path}: operations.{operation}"
    if not ranges:
        raise ConfigError(f"{field}: no split, allowed train, validation or held_out")
    if "held_out" in ranges and len(ranges) > 1:
        raise ConfigError(
            f"{field}: {', '.join(ranges)}, a held-out operation is allowed no other split"
        )
    taken: set[int] = set()
    for split, (first, last) in ranges.items():
        if not 0 <= last - first < MAX_SEEDS:
            raise ConfigError(
                f"{field}.{split}: [{first}, {last}], allowed first <= last and at most "
                f"{MAX_SEEDS} seeds"
            )
        seeds = set(range(first, last + 1))
        if seeds & taken:
            raise ConfigError(f"{field}.{split}: seed {min(seeds & taken)} is in two splits")
        taken |= seeds


@lru_cache(maxsize=1)
def listed() -> tuple[Listed, ...]:
    """The shipped list.

    Raises:
        ConfigError: see :func:`read_splits`.
    """
    return read_splits(resource_path("config", "cycle", "splits.yaml"))
