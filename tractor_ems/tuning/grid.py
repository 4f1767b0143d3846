"""The declared grid of the baselines' settings, and the cycles it is searched on."""

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from tractor_ems.policies.baselines import BASELINES, TUNED_ONLY, make_baseline
from tractor_ems.tuning.dev_set import bus_demand_w
from tractor_ems.tuning.sdp_bags import sdp_settings
from tractor_msgs_py.errors import ConfigError, TractorEmsError
from tractor_sim.config import describe
from tractor_sim.powertrain import PowertrainParams
from tractor_sim.resources import resource_path
from tractor_sim.yaml_file import read_yaml

_STRICT = ConfigDict(extra="forbid")

Name = Annotated[str, Field(min_length=1, max_length=80)]
Value = float | int | str
Axes = dict[Name, Annotated[list[Value], Field(min_length=1, max_length=50)]]
Share = Annotated[float, Field(gt=0, le=1)]

MOST_SETTINGS = 5000
"""Of one policy: a grid with more is a slip of the pen."""


@dataclass(frozen=True, config=_STRICT)
class Seeds:
    """Cycles OPERATION_SEED of an inclusive range of seeds, and other cycles by name."""

    operations: tuple[Name, ...]
    seeds: tuple[int, int]
    others: tuple[Name, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """All of them, in order."""
        first, last = self.seeds
        of_seeds = (f"{o}_{s}" for o in self.operations for s in range(first, last + 1))
        return (*of_seeds, *self.others)


@dataclass(frozen=True, config=_STRICT)
class Squeezed:
    """Work squeezed in time and power, to look at the chosen settings with, not to choose by."""

    seed: Annotated[int, Field(ge=0)]
    operations: tuple[Name, ...]
    seeds: tuple[int, int]

    @property
    def names(self) -> tuple[str, ...]:
        """The cycles that are squeezed."""
        return Seeds(self.operations, self.seeds).names


@dataclass(frozen=True, config=_STRICT)
class Preset:
    """What is searched: settings by policy, each a list of values; a part of the dev cycles."""

    policies: dict[Name, Axes]
    every: Annotated[int, Field(ge=1, le=100)] = 1


@dataclass(frozen=True, config=_STRICT)
class Grid:
    """A whole search.

    Attributes:
        dev: cycles that decide; train: cycles whose demand stochastic DP is fitted to.
        squeezed: what chosen settings are looked at with besides.
        soc_mean, soc_max: most mean and largest |final SOC - target| of a setting that counts.
        presets: budgets by name.
    """

    dev: Seeds
    train: Seeds
    squeezed: Squeezed
    soc_mean: Share
    soc_max: Share
    presets: dict[Name, Preset]

    def preset(self, name: str) -> Preset:
        """One of the presets.

        Raises:
            ConfigError: no such preset.
        """
        if name not in self.presets:
            raise ConfigError(f"preset {name!r}: unknown, allowed {', '.join(self.presets)}")
        return self.presets[name]


def load_grid(params: PowertrainParams, path: Path | None = None) -> Grid:
    """A grid file, default ``config/baseline/grid.yaml``; every setting in it can be made.

    Raises:
        ConfigError: not such a file; an unknown policy or setting, or one out of range.
        CycleError: a cycle is unknown or held out.
    """
    found = path or resource_path("config", "baseline", "grid.yaml")
    try:
        grid: Grid = TypeAdapter(Grid).validate_python(read_yaml(found))
    except ValidationError as error:
        raise ConfigError(f"{found}: {describe(error)}") from None
    for label, preset in grid.presets.items():
        for name, axes in preset.policies.items():
            where = f"{found}: presets.{label}.policies.{name}"
            if name not in (*BASELINES, *TUNED_ONLY):
                known = ", ".join((*BASELINES, *TUNED_ONLY))
                raise ConfigError(f"{where}: unknown, allowed {known}")
            try:
                for settings in combinations(axes):
                    _try(name, params, settings)
            except TractorEmsError as error:
                raise ConfigError(f"{where}: {error}") from None
    for name in (*grid.dev.names, *grid.train.names, *grid.squeezed.names):
        bus_demand_w(name, params.p_aux_w)
    return grid


def combinations(axes: Mapping[str, list[Value]]) -> list[dict[str, Any]]:
    """Every combination of the axes' values, the last axis fastest.

    Raises:
        ConfigError: more than :data:`MOST_SETTINGS`.
    """
    count = 1
    for values in axes.values():
        count *= len(values)
    if count > MOST_SETTINGS:
        raise ConfigError(f"{count} combinations, allowed at most {MOST_SETTINGS}")
    return [dict(zip(axes, values, strict=True)) for values in itertools.product(*axes.values())]


def _try(name: str, params: PowertrainParams, settings: Mapping[str, Any]) -> None:
    if name in TUNED_ONLY:
        sdp_settings(params, planned=name == "sdp", given=settings)
    else:
        make_baseline(name, params, settings)
