"""Settings of the held-out study: one YAML file holds every choice, presets hold the budgets."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from tractor_ems.learning.config import Count, Fraction, load_train_config
from tractor_ems.policies.registry import RULES
from tractor_ems.study.disturbances import Disturbance
from tractor_ems.study.held_out_policies import DP
from tractor_msgs_py.errors import ConfigError, TractorEmsError
from tractor_sim.config import describe, load_powertrain
from tractor_sim.duty_cycle.library import cycle_names, listed_cycles
from tractor_sim.duty_cycle.splits import Listed
from tractor_sim.resources import resource_path
from tractor_sim.yaml_file import read_yaml

_STRICT = ConfigDict(extra="forbid")

Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]+$")]
Few = Annotated[int, Field(ge=0, le=1000)]
Bar = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]


@dataclass(frozen=True, config=_STRICT)
class Learner:
    """A learned policy: what tables call it, and its preset of ``config/training``."""

    name: Name
    preset: str


@dataclass(frozen=True, config=_STRICT)
class Table:
    """A stochastic DP, fitted to the same bags; whether it knows the planned end."""

    name: Name
    planned: bool


@dataclass(frozen=True, config=_STRICT)
class Vehicle:
    """Another vehicle: its powertrain, and the factor on the demand of every cycle."""

    powertrain: str
    scale: Annotated[float, Field(gt=0.0, le=10.0)]


@dataclass(frozen=True, config=_STRICT)
class Bars:
    """What the study is to show; every bar is reported as met or missed.

    Attributes:
        median, worst: least dp_ratio of the subject over all runs; stretch_*: hoped for.
        soc_each, soc_mean: largest |final SOC - target| of a run and on average.
        starts: most engine starts over those of ``starts_of``.
        lossy: loss of ``never_stop`` to DP from which on an operation counts as hard.
        train_s: longest time from bags to policy file; transitions: most of them recorded.
        fewer_episodes: how many times fewer than ``paper_episodes``.
        robust: share of the disturbances in which ``never_stop`` may not lose less.
        bug: a dp_ratio above this is a bug, not a result.
    """

    median: Bar
    worst: Bar
    stretch_median: Bar
    stretch_worst: Bar
    soc_each: Bar
    soc_mean: Bar
    starts: Bar
    lossy: Bar
    train_s: Bar
    transitions: Count
    fewer_episodes: Bar
    paper_episodes: Count
    robust: Fraction
    bug: Bar


@dataclass(frozen=True, config=_STRICT)
class Budget:
    """What a preset spends.

    Attributes:
        train_seeds: of every training operation, inclusive; train_cycles: more training cycles.
        cycles: scored cycles by name; empty: the whole held-out split.
        dev: cycles on which the learning curve is scored.
        seeds: training runs per learner, seeds 0, 1, ...
        updates: gradient steps of every training run; None: the preset's own.
        curve_bags: numbers of recorded runs of the learning curve, besides all of them.
        curve_seeds: training runs per point of the curve.
        robust_cycles: scored cycles per operation under disturbances; 0 leaves that part out.
        robust_seeds: training runs of each learner that are disturbed.
        transfer_seeds: of every training operation that another vehicle learns from, inclusive.
        transfer_cycles: scored cycles per operation on other vehicles; 0 leaves that part out.
        traces: scored cycles whose traces are shown.
        resamples: of every bootstrap.
    """

    train_seeds: tuple[Count, Count]
    train_cycles: tuple[str, ...]
    dev: tuple[str, ...]
    seeds: Annotated[int, Field(ge=1, le=100)]
    curve_bags: tuple[Count, ...]
    curve_seeds: Annotated[int, Field(ge=1, le=100)]
    robust_cycles: Few
    robust_seeds: Annotated[int, Field(ge=1, le=100)]
    transfer_seeds: tuple[Count, Count]
    transfer_cycles: Few
    traces: tuple[str, ...]
    cycles: tuple[str, ...] = ()
    updates: Count | None = None
    resamples: Annotated[int, Field(ge=10, le=100_000)] = 2000


@dataclass(frozen=True, config=_STRICT)
class _File:
    powertrain: str
    train_operations: tuple[str, ...]
    recorders: tuple[Name, ...]
    subject: Name
    never_stop: Name
    starts_of: Name
    opponents: tuple[Name, ...]
    rules: tuple[Name, ...]
    learners: tuple[Learner, ...]
    tables: tuple[Table, ...]
    disturbances: tuple[Disturbance, ...]
    vehicles: tuple[Vehicle, ...]
    bars: Bars
    presets: dict[str, Budget]

    def __post_init__(self) -> None:
        names = self.names
        if len(set(names)) < len(names):
            raise ConfigError(f"rules, learners, tables: a name twice in {', '.join(names)}")
        for field in ("subject", "never_stop", "starts_of", "opponents"):
            value = getattr(self, field)
            for name in (value,) if isinstance(value, str) else value:
                if name not in names:
                    raise ConfigError(f"{field}: {name!r}, allowed {', '.join(names)}")
        listed = [item.name for item in self.disturbances]
        if len(set(listed)) < len(listed) or "none" in listed:
            raise ConfigError(f"disturbances: {', '.join(listed)}, allowed no name twice, no none")

    @property
    def names(self) -> list[str]:
        """Every policy: learners, tables, rules."""
        return [*(i.name for i in self.learners), *(i.name for i in self.tables), *self.rules]


@dataclass(frozen=True)
class HeldOutConfig:
    """The study with one budget; see the file ``config/study/held_out.yaml``.

    Attributes:
        preset: name of the budget.
        settings: the file less its presets.
        budget: see there.
    """

    preset: str
    settings: _File
    budget: Budget

    @property
    def training(self) -> list[str]:
        """Names of the cycles that are recorded for training."""
        return [*self._of(self.budget.train_seeds), *self.budget.train_cycles]

    @property
    def transfer_training(self) -> list[str]:
        """Names of the cycles that other vehicles learn from, before scaling."""
        return self._of(self.budget.transfer_seeds)

    @property
    def scored(self) -> list[str]:
        """Names of the cycles that every policy drives."""
        return list(self.budget.cycles) or cycle_names("held_out")

    def subset(self, per_operation: int) -> list[str]:
        """The first so many scored cycles of every operation."""
        taken: dict[str, int] = {}
        names = []
        for row in map(_listed, self.scored):
            taken[row.operation] = taken.get(row.operation, 0) + 1
            if taken[row.operation] <= per_operation:
                names.append(row.name)
        return names

    def seeds_of(self, policy: str) -> list[int | None]:
        """Training seeds of a policy; one None where it learns nothing at random."""
        learnt = policy in {item.name for item in self.settings.learners}
        return list(range(self.budget.seeds)) if learnt else [None]

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        data = asdict(self.settings)
        del data["presets"]
        return {"preset": self.preset, "budget": asdict(self.budget), **data}

    def _of(self, seeds: tuple[int, int]) -> list[str]:
        first, last = seeds
        names = [
            f"{operation}_{seed}"
            for operation in self.settings.train_operations
            for seed in range(first, last + 1)
        ]
        for name in names:
            _listed(name)
        return names


def _listed(name: str) -> Listed:
    rows = {row.name: row for row in listed_cycles()}
    if name not in rows:
        raise ConfigError(f"cycle {name!r}: is not listed")
    return rows[name]


def load_held_out(settings: str, preset: str) -> HeldOutConfig:
    """The study of ``config/study/NAME.yaml``, or a YAML file, with one of its presets.

    Raises:
        ConfigError: the file is missing, has an unknown key or a value out of range, or no such
            preset; a training cycle is not of the training split; something named in it is not
            there.
    """
    path = Path(settings)
    if path.suffix not in (".yaml", ".yml"):
        path = resource_path("config", "study") / f"{settings}.yaml"
    if not path.is_file():
        raise ConfigError(f"study settings {settings!r}: no such file")
    document = read_yaml(path)
    try:
        file = TypeAdapter(_File).validate_python(document)
    except ValidationError as error:
        raise ConfigError(f"{path}: {describe(error)}") from None
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    if preset not in file.presets:
        raise ConfigError(f"{path}: preset {preset!r}, allowed {', '.join(file.presets)}")
    config = HeldOutConfig(preset, file, file.presets[preset])
    try:
        _check_cycles(config)
        _check_named(config.settings)
    except TractorEmsError as error:
        raise ConfigError(f"{path}: {error}") from None
    return config


def _check_cycles(config: HeldOutConfig) -> None:
    budget = config.budget
    for field in ("train_seeds", "transfer_seeds"):
        first, last = getattr(budget, field)
        if first > last:
            raise ConfigError(f"{field}: [{first}, {last}], allowed the lower seed first")
    for name in (*config.training, *config.transfer_training):
        split = _listed(name).split
        if split != "train":
            raise ConfigError(f"training cycle {name} is {split}, allowed train")
    for name in budget.dev:
        if _listed(name).split == "held_out":
            raise ConfigError(f"dev cycle {name} is held_out, allowed train, validation")
    for name in config.scored:
        _listed(name)
    for name in budget.traces:
        if name not in config.scored:
            raise ConfigError(f"traces: {name} is not among the scored cycles")


def _check_named(settings: _File) -> None:
    """Whatever is named can be had: a study gets to some of it after hours only."""
    load_powertrain(settings.powertrain)
    for vehicle in settings.vehicles:
        load_powertrain(vehicle.powertrain)
    for learner in settings.learners:
        load_train_config(learner.preset)
    allowed = (*RULES, DP)
    for field in ("recorders", "rules"):
        for name in getattr(settings, field):
            if name not in allowed:
                raise ConfigError(f"{field}: {name!r}, allowed {', '.join(allowed)}")
