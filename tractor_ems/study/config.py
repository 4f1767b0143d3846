"""Settings of the study: one YAML file holds every choice, its presets hold the budgets."""

from dataclasses import asdict, fields
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from tractor_ems.learning.config import Count, Discount, Fraction, Rate, Widths
from tractor_ems.learning.mdp import ActionMapping
from tractor_ems.learning.rewards import RewardKind
from tractor_ems.study.rows import Algorithm, Row, SeedingKind
from tractor_msgs_py.errors import ConfigError, CycleError
from tractor_sim.config import describe, load_powertrain
from tractor_sim.duty_cycle.library import load_cycle
from tractor_sim.duty_cycle.shipped import refuse_held_out
from tractor_sim.resources import resource_path
from tractor_sim.yaml_file import read_yaml

_STRICT = ConfigDict(extra="forbid")

NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]


@dataclass(frozen=True, config=_STRICT)
class NetworkSettings:
    """DQN and double DQN.

    Attributes:
        hidden: widths of the hidden layers.
        gamma: discount per step.
        learning_rate: of Adam, constant.
        batch: transitions per update, even.
        replay_capacity: transitions.
        warm_up: transitions before the first update.
        epsilon_end: exploration after its linear fall from the row's start over
            ``epsilon_decay_share`` of the episodes.
    """

    hidden: Widths
    gamma: Discount
    learning_rate: Rate
    batch: Annotated[int, Field(ge=2, le=4096, multiple_of=2)]
    replay_capacity: Count
    warm_up: Count
    epsilon_end: Fraction
    epsilon_decay_share: Rate


@dataclass(frozen=True, config=_STRICT)
class TableSettings:
    """Q-learning and double Q-learning.

    Attributes:
        soc_bins, demand_bins: of the table.
        gamma: discount per step; alpha: step size.
        epsilon_end, epsilon_decay_share: as for networks.
    """

    soc_bins: Annotated[int, Field(ge=1, le=10_000)]
    demand_bins: Annotated[int, Field(ge=1, le=10_000)]
    gamma: Discount
    alpha: Rate
    epsilon_end: Fraction
    epsilon_decay_share: Rate


@dataclass(frozen=True, config=_STRICT)
class ExpertSettings:
    """Whose runs seed the replay: cycles planter_SEED of the inclusive range, and shares of it."""

    seeds: tuple[Count, Count]
    dp_share: Fraction
    rule_share: Fraction


@dataclass(frozen=True, config=_STRICT)
class Budget:
    """What a preset spends.

    Attributes:
        seeds: runs per row, seeds 0, 1, ...
        ablation_seeds: runs of a row that asks a question of ours; None: as many.
        network_episodes, table_episodes: training episodes per run.
        steps_per_update: environment steps per gradient step of a network.
        network_eval_every, table_eval_every: episodes between greedy evaluations.
        replay_capacity: None: the networks' own.
    """

    seeds: Annotated[int, Field(ge=1, le=100)]
    network_episodes: Count
    steps_per_update: Count
    network_eval_every: Count
    table_episodes: Count
    table_eval_every: Count
    replay_capacity: Count | None = None
    ablation_seeds: Annotated[int, Field(ge=1, le=100)] | None = None

    def seeds_of(self, row: Row) -> range:
        """Seeds of a row's runs."""
        own = self.ablation_seeds if row.role == "ablation" else None
        return range(own or self.seeds)


@dataclass(frozen=True, config=_STRICT)
class _RowSettings:
    id: Annotated[str, Field(pattern=r"^[a-z0-9_]+$")]
    label: str
    algorithm: Algorithm
    reward: RewardKind
    soc_min: tuple[Fraction, ...]
    role: Literal["paper", "ablation"] = "paper"
    mapping: ActionMapping = "p_batt_grid"
    actions: Annotated[int, Field(ge=2, le=30_000)] = 1600
    soc_bins: Count | None = None
    interpolate: bool = False
    epsilon_start: Fraction = 1.0
    seeding: SeedingKind = "none"
    replay: Literal["fifo", "kept"] = "fifo"
    margin: NotNegative = 0.0
    target_every: Count = 1000
    target_rate: Rate = 1.0

    def __post_init__(self) -> None:
        tabular = self.algorithm in ("q", "double_q")
        if tabular and self.seeding != "none":
            raise ConfigError(f"row {self.id}: seeding {self.seeding}, tables have no replay")
        if tabular and (self.soc_bins, self.target_every, self.target_rate) != (None, 1000, 1.0):
            raise ConfigError(
                f"row {self.id}: soc_bins, target_every, target_rate are of networks"
            )
        if self.interpolate and not tabular:
            raise ConfigError(f"row {self.id}: interpolate is of tables, not of {self.algorithm}")
        if self.replay == "kept" and self.seeding == "none":
            raise ConfigError(f"row {self.id}: replay kept, but seeding none")
        if self.margin > 0.0 and self.replay != "kept":
            raise ConfigError(f"row {self.id}: margin {self.margin}, allowed with replay kept")


@dataclass(frozen=True, config=_STRICT)
class _Difference:
    subject: str
    kind: Literal["silent", "different", "slip"]
    paper: str
    here: str
    why: str


@dataclass(frozen=True, config=_STRICT)
class _File:
    powertrain: str
    cycle: str
    soc_initial: Fraction
    soc_target: Fraction
    networks: NetworkSettings
    tables: TableSettings
    experts: ExpertSettings
    presets: dict[str, Budget]
    rows: tuple[_RowSettings, ...]
    differences: tuple[_Difference, ...]


@dataclass(frozen=True)
class StudyConfig:
    """The study with one budget.

    Attributes:
        preset: its name.
        powertrain, cycle: shipped names or files.
        soc_initial, soc_target: of every run.
        networks, tables, experts, budget: see there.
        rows: every row at every SOC_min, in the file's order.
        differences: rows of the table "differences from the paper": subject, kind (silent,
            different or slip), paper, here, why.
    """

    preset: str
    powertrain: str
    cycle: str
    soc_initial: float
    soc_target: float
    networks: NetworkSettings
    tables: TableSettings
    experts: ExpertSettings
    budget: Budget
    rows: tuple[Row, ...]
    differences: tuple[dict[str, str], ...]

    def identity(self, row: Row) -> dict[str, Any]:
        """Every setting that decides a run of ``row`` besides its seed, as plain data."""
        budget = asdict(self.budget)
        kind = "table" if row.tabular else "network"
        used = {n: v for n, v in budget.items() if n.startswith(kind)}
        if not row.tabular:
            used["steps_per_update"] = self.budget.steps_per_update
        settings = asdict(self.tables if row.tabular else self.networks)
        if not row.tabular:
            settings["replay_capacity"] = self.replay_capacity
        return {
            "row": {n: v for n, v in row.to_json().items() if n not in ("label", "role")},
            "settings": settings,
            "budget": used,
            "experts": asdict(self.experts) if row.seeding != "none" else None,
            "cycle": self.cycle,
            "soc_initial": self.soc_initial,
            "soc_target": self.soc_target,
        }

    @property
    def replay_capacity(self) -> int:
        """Of the networks, as the preset has it."""
        return self.budget.replay_capacity or self.networks.replay_capacity


def load_study(name_or_path: str | Path, preset: str) -> StudyConfig:
    """A study by name (``config/study/NAME.yaml``) or YAML file, with one of its presets.

    Raises:
        ConfigError: unknown study or preset, unknown key, or a value out of range.
    """
    path = _find(name_or_path)
    try:
        file = TypeAdapter(_File).validate_python(read_yaml(path))
    except ValidationError as error:
        raise ConfigError(f"{path}: {describe(error)}") from None
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    if preset not in file.presets:
        raise ConfigError(f"{path}: preset {preset!r}, allowed {', '.join(file.presets)}")
    rows = tuple(_row(item, soc_min) for item in file.rows for soc_min in item.soc_min)
    _check(path, file, rows)
    return StudyConfig(
        preset=preset,
        powertrain=file.powertrain,
        cycle=file.cycle,
        soc_initial=file.soc_initial,
        soc_target=file.soc_target,
        networks=file.networks,
        tables=file.tables,
        experts=file.experts,
        budget=file.presets[preset],
        rows=rows,
        differences=tuple(_difference(item, file.presets[preset]) for item in file.differences),
    )


def _check(path: Path, file: _File, rows: tuple[Row, ...]) -> None:
    """What no field can check alone."""
    keys = [row.key for row in rows]
    for key in keys:
        if keys.count(key) > 1:
            raise ConfigError(f"{path}: rows: {key} is there twice")
    experts, networks = file.experts, file.networks
    if experts.dp_share + experts.rule_share > 1.0:
        raise ConfigError(
            f"{path}: experts.rule_share: {experts.rule_share} beside dp_share "
            f"{experts.dp_share}, together allowed 0..1"
        )
    for name, budget in file.presets.items():
        capacity = budget.replay_capacity or networks.replay_capacity
        if networks.warm_up > capacity:
            raise ConfigError(
                f"{path}: networks.warm_up: {networks.warm_up}, allowed at most the replay's "
                f"capacity, {capacity} in preset {name}"
            )
    try:
        refuse_held_out(load_cycle(file.cycle))
    except CycleError as error:
        raise ConfigError(f"{path}: cycle: {error}") from None
    soc_max = load_powertrain(file.powertrain).battery.soc_max
    for row in rows:
        for name in ("soc_initial", "soc_target"):
            soc = getattr(file, name)
            if not row.soc_min <= soc <= soc_max:
                raise ConfigError(
                    f"{path}: {name}: {soc}, allowed {row.soc_min:g}..{soc_max:g} in row {row.key}"
                )


def _difference(item: _Difference, budget: Budget) -> dict[str, str]:
    """With the preset's own number where the text leaves a place for it."""
    number = f"{budget.steps_per_update:,}"
    return {**asdict(item), "here": item.here.replace("{steps_per_update}", number)}


def _row(item: _RowSettings, soc_min: float) -> Row:
    given = {field.name: getattr(item, field.name) for field in fields(item)}
    return Row(**{**given, "soc_min": soc_min})


def _find(name_or_path: str | Path) -> Path:
    text = str(name_or_path)
    if text.endswith((".yaml", ".yml")) or "/" in text:
        path = Path(text)
        if not path.is_file():
            raise ConfigError(f"{path}: no such study file")
        return path
    folder = resource_path("config", "study")
    path = folder / f"{text}.yaml"
    if not path.is_file():
        known = ", ".join(sorted(item.stem for item in folder.glob("*.yaml")))
        raise ConfigError(f"study {text!r}: unknown, shipped are: {known}")
    return path
