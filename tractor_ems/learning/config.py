"""Settings of a training run, checked where they are made; presets are config/training/*.yaml."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from tractor_ems.learning.knots_config import KnotsConfig
from tractor_ems.learning.rewards import RewardConfig
from tractor_msgs_py.errors import ConfigError
from tractor_sim.config import describe
from tractor_sim.resources import resource_path
from tractor_sim.yaml_file import read_yaml

_STRICT = ConfigDict(extra="forbid")

Count = Annotated[int, Field(ge=1, le=100_000_000)]
Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
Discount = Annotated[float, Field(ge=0.0, lt=1.0)]
Rate = Annotated[float, Field(gt=0.0, le=1.0)]
Seconds = Annotated[float, Field(gt=0.0, le=86_400.0)]
Positive = Annotated[float, Field(gt=0.0, le=1e6)]
NotNegative = Annotated[float, Field(ge=0.0, le=1e6)]
Width = Annotated[int, Field(ge=1, le=4096)]
Widths = Annotated[tuple[Width, ...], Field(min_length=1, max_length=15)]
ActivationName = Literal["relu", "tanh"]
Targets = Literal["counterfactual", "sampled", "run_or_stand"]
LossName = Literal["huber", "mse"]
Parametrisation = Literal["p_batt_grid", "p_eng_knots"]


@dataclass(frozen=True, config=_STRICT)
class CounterfactualConfig:
    """Double Q-learning on the post-decision value, all actions of every sample.

    Attributes:
        updates: gradient steps.
        batch: samples (bag, time, SOC, target) per step; both engine states of each are used.
        learning_rate: of Adam, held for ``hold_fraction`` of the updates, then lowered along a
            cosine to ``final_fraction`` of it.
        gamma: discount per second; over a step of dt_s it is ``gamma ** dt_s``.
        target_rate: share of the online net that the target net takes over per update at steps
            of 1 s; at shorter ones in proportion more, for as many more steps reach as far.
        double: choose with the online net, evaluate with the target net; else the target net
            does both.
        loss: on the value error in cost units (10 g).
        hidden, activation: of the network.
    """

    updates: Count = 3000
    batch: Count = 256
    learning_rate: Rate = 2e-3
    hold_fraction: Fraction = 0.5
    final_fraction: Fraction = 0.02
    gamma: Discount = 0.98
    target_rate: Rate = 0.01
    double: bool = True
    loss: LossName = "mse"
    hidden: Widths = (64, 64)
    activation: ActivationName = "tanh"


@dataclass(frozen=True, config=_STRICT)
class SampledConfig:
    """Double DQN on replayed transitions, the paper's way.

    Attributes:
        updates: gradient steps.
        batch: transitions per step.
        learning_rate: of Adam, with the same schedule as in ``CounterfactualConfig``.
        gamma: discount per second; over a step of dt_s it is ``gamma ** dt_s``.
        target_rate: soft update per step; 1 with ``target_every`` above 1 is a hard copy.
        target_every: updates between target updates.
        double: double DQN; False is plain DQN.
        loss: on the temporal difference in reward units; ``mse`` is half its square here.
        hidden, activation: of the network; its head has one output per action.
        replay_capacity: transitions in the FIFO.
        dp_share, rule_share: share of the capacity seeded from DP and rule-based bags.
        epsilon_start, epsilon_end: exploration of simulated episodes, linear over them.
    """

    updates: Count = 6000
    batch: Count = 64
    learning_rate: Rate = 1e-3
    hold_fraction: Fraction = 0.5
    final_fraction: Fraction = 0.02
    gamma: Discount = 0.98
    target_rate: Rate = 0.01
    target_every: Count = 1
    double: bool = True
    loss: LossName = "huber"
    hidden: Widths = (64, 64)
    activation: ActivationName = "relu"
    replay_capacity: Count = 200_000
    dp_share: Fraction = 0.25
    rule_share: Fraction = 0.0
    epsilon_start: Fraction = 1.0
    epsilon_end: Fraction = 0.05

    def __post_init__(self) -> None:
        if self.dp_share + self.rule_share > 1.0:
            raise ConfigError(
                f"sampled.rule_share: {self.rule_share} beside dp_share {self.dp_share}, "
                "together allowed 0..1"
            )


@dataclass(frozen=True, config=_STRICT)
class Augmentation:
    """Demand made from the recorded one, so that work is also seen that was not recorded.

    Attributes:
        scaled: series, per 100 recorded ones, whose power is scaled by a factor in
            ``scale_range``.
        squeezed: series, per 100 recorded ones, whose time is squeezed to a share in
            ``squeeze_range`` as well, repeated to their old length, and whose power is scaled by
            one in ``squeeze_scale_range``: shorter strokes.
    """

    scaled: Annotated[int, Field(ge=0, le=10_000)] = 40
    scale_range: tuple[Positive, Positive] = (0.4, 1.25)
    squeezed: Annotated[int, Field(ge=0, le=10_000)] = 60
    squeeze_range: tuple[Positive, Positive] = (0.2, 0.7)
    squeeze_scale_range: tuple[Positive, Positive] = (0.35, 0.9)


@dataclass(frozen=True, config=_STRICT)
class RunOrStandConfig:
    """Letting the engine run or stand, for engines that start slowly; see ``run_or_stand``.

    Attributes:
        planned: the policy knows when the work is planned to end and pays for SOC then; else it
            pays for being off its target all the time.
        updates, batch: gradient steps; ticks per step, each at ``errors`` SOC errors.
        learning_rate, hold_fraction, final_fraction: as in ``CounterfactualConfig``.
        target_rate: share of the online net that the averaged one takes over per update; the
            averaged one is the policy's.
        gamma: discount per second.
        commit_s: how long a choice lasts in the targets.
        horizon_s: farthest time left that is learned; near_end: share of the samples drawn from
            the last ``near_end_s``.
        end_kg: cost of a SOC error at the planned end, per SOC^2.
        holding_kg_per_s, wall_kg_per_s, wall_at, most_kg_per_s: cost of a SOC error e per second,
            min(holding e^2 + wall (e / wall_at)^16, most).
        price: of a unit of SOC, times the marginal fuel of a running engine.
        soc_scale: of the SOC error as an input; soc_width: half width of the errors drawn, less
            where ``soc_per_s`` would not lead back in time.
        gain_weight: weight of G's squared error against that of V about its mean per tick.
        margin_kg: added to what standing saves when the policy is made: near the top of the window
            a price that is a little too low stops the charging, and the engine would idle on.
            Chosen by hand on the dev cycles.
        short_kg_per_j: price of demand left unmet.
        double: choose with the online net, evaluate with the averaged one; of no effect while
            ``table_updates`` last.
        hidden: of the network, tanh.
        table_updates: first updates whose targets go on with the values of stochastic DP, fitted
            to the same demand, instead of the network's own; 0: none, nothing is fitted.
        low_pass_s, mean_prior_s: demand filters that the policy sees.
        augmentation: demand made from the recorded one.
    """

    planned: bool = True
    updates: Count = 4_000
    batch: Count = 128
    errors: Annotated[int, Field(ge=2, le=64)] = 4
    learning_rate: Rate = 2e-3
    hold_fraction: Fraction = 0.4
    final_fraction: Fraction = 0.01
    target_rate: Rate = 0.01
    gamma: Annotated[float, Field(ge=0.0, le=1.0)] = 1.0
    commit_s: Seconds = 12.0
    horizon_s: Seconds = 2400.0
    near_end: Fraction = 0.25
    near_end_s: Seconds = 400.0
    end_kg: Annotated[float, Field(ge=0.0, le=1e6)] = 30.0
    holding_kg_per_s: NotNegative = 0.0
    wall_kg_per_s: NotNegative = 6e-4
    wall_at: Positive = 0.22
    most_kg_per_s: NotNegative = 1.2e-3
    price: Positive = 1.02
    soc_scale: Positive = 0.05
    soc_width: Positive = 0.24
    soc_per_s: Positive = 4e-4
    gain_weight: NotNegative = 8.0
    margin_kg: NotNegative = 0.002
    short_kg_per_j: NotNegative = 2e-6
    double: bool = True
    hidden: tuple[Width, Width] = (64, 64)
    table_updates: Annotated[int, Field(ge=0, le=100_000_000)] = 0
    low_pass_s: Annotated[tuple[Seconds, ...], Field(max_length=8)] = (8.0, 30.0, 120.0)
    mean_prior_s: Seconds = 600.0
    augmentation: Augmentation = Augmentation()


Mode: TypeAlias = CounterfactualConfig | SampledConfig | RunOrStandConfig | KnotsConfig


@dataclass(frozen=True, config=_STRICT)
class TrainConfig:
    """One training run; everything that decides its result besides the bags.

    Attributes:
        targets: ``counterfactual`` (the plant is known, demand exogenous: all actions of every
            recorded step), ``run_or_stand`` (the same for engines that start slowly: every
            recorded stretch with the engine running and standing) or ``sampled`` (replayed
            transitions).
        reward: see ``rewards.RewardConfig``.
        powertrain: shipped name or YAML file.
        allow_other_powertrain: use bags recorded on another powertrain; of their demand only, so
            not with ``sampled``.
        allow_held_out: use bags of held-out cycles, which makes any score on those worthless.
        seed: of every generator.
        actions: size of the battery-power grid; 1600 is the paper's.
        interact: simulated episodes to add.
        mean_prior_s, low_pass_s: demand filters that the policy sees; ``run_or_stand`` has its
            own.
        parametrisation: of ``sampled``: the paper's grid over battery power, or ``p_eng_knots``,
            off and knots of engine power, for engines that start slowly.
        counterfactual, sampled, run_or_stand: settings of the modes; knots: of ``sampled`` with
            ``p_eng_knots``.
        checkpoint_every: updates between checkpoints; the last one is always kept.
    """

    targets: Targets = "counterfactual"
    reward: RewardConfig = RewardConfig()
    powertrain: str = "paper"
    allow_other_powertrain: bool = False
    allow_held_out: bool = False
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    actions: Annotated[int, Field(ge=2, le=30_000)] = 1600
    interact: Annotated[int, Field(ge=0, le=1_000_000)] = 0
    mean_prior_s: Seconds = 120.0
    low_pass_s: Seconds = 8.0
    counterfactual: CounterfactualConfig = CounterfactualConfig()
    sampled: SampledConfig = SampledConfig()
    run_or_stand: RunOrStandConfig = RunOrStandConfig()
    parametrisation: Parametrisation = "p_batt_grid"
    knots: KnotsConfig = KnotsConfig()
    checkpoint_every: Count = 1000

    def __post_init__(self) -> None:
        if self.allow_other_powertrain and self.targets == "sampled":
            raise ConfigError(
                "allow_other_powertrain: true with targets sampled, which would replay what "
                "another plant did; allowed with targets counterfactual and run_or_stand"
            )

    @property
    def updates(self) -> int:
        """Gradient steps of the chosen mode."""
        return self.mode.updates

    @property
    def mode(self) -> Mode:
        """Settings of the chosen mode."""
        modes: dict[Targets, Mode] = {
            "counterfactual": self.counterfactual,
            "sampled": self.sampled if self.parametrisation == "p_batt_grid" else self.knots,
            "run_or_stand": self.run_or_stand,
        }
        return modes[self.targets]

    def to_json(self) -> dict[str, Any]:
        """Plain data, for policy files and checkpoints."""
        return asdict(self)


def step_discount(mode: CounterfactualConfig | SampledConfig, dt_s: float) -> float:
    """Discount over one step of ``dt_s`` seconds, so that a horizon is a time, not a count."""
    return float(mode.gamma**dt_s)


def step_target_rate(config: CounterfactualConfig, dt_s: float) -> float:
    """Share of the online net that the target net takes over per update at steps of ``dt_s``."""
    return min(config.target_rate / dt_s, 1.0)


def learning_rate(mode: Mode, step: int) -> float:
    """Learning rate of update number ``step`` (from 0): held, then a cosine down."""
    begin = mode.hold_fraction * mode.updates
    if step <= begin:
        return mode.learning_rate
    done = min((step - begin) / (mode.updates - begin), 1.0)
    low = mode.final_fraction
    return mode.learning_rate * (low + (1.0 - low) * 0.5 * (1.0 + math.cos(math.pi * done)))


def rule_share_of(given: float | None, rule_bags: Sequence[object] | None) -> float | None:
    """Replay share of rule-based recordings: as given; the paper's quarter where such bags are
    named but no share (None or negative); None, the preset's, where neither is."""
    if given is not None and given >= 0:
        return given
    return 0.25 if any(rule_bags or ()) else None


def preset_of(targets: str | None) -> str | None:
    """The shipped preset that stands for targets named without one; None for none."""
    return {"run_or_stand": "field"}.get(targets or "", targets) or None


def load_train_config(
    preset: str | Path | None = None, overrides: Mapping[str, Any] | None = None
) -> TrainConfig:
    """A preset by name (``config/training/NAME.yaml``) or YAML file, with overrides on top.

    Args:
        preset: None: the defaults.
        overrides: nested like the file, or by dotted name: ``{"sampled.updates": 5000}``. None
            values are left out, so that a command line's unset options change nothing.
            ``updates`` means those of the chosen mode.

    Raises:
        ConfigError: unknown preset, unreadable file, unknown key, or a value out of range.
    """
    source = "training settings"
    data: dict[str, Any] = {}
    if preset is not None:
        path = _find(preset)
        source = str(path)
        loaded = read_yaml(path)
        if not isinstance(loaded, dict):
            raise ConfigError(f"{path}: {type(loaded).__name__}, expected a mapping of settings")
        data = loaded
    for name, value in (overrides or {}).items():
        if value is not None and name != "updates":
            _put(data, name.split("."), value)
    updates = (overrides or {}).get("updates")
    if updates is not None:
        mode = str(data.get("targets", "counterfactual"))
        if mode == "sampled" and data.get("parametrisation") == "p_eng_knots":
            mode = "knots"
        _put(data, [mode, "updates"], updates)
    try:
        return TypeAdapter(TrainConfig).validate_python(data)
    except ValidationError as error:
        raise ConfigError(f"{source}: {describe(error)}") from None
    except ConfigError as error:
        raise ConfigError(f"{source}: {error}") from None


def _put(data: dict[str, Any], keys: list[str], value: Any) -> None:
    inner = data.setdefault(keys[0], {}) if len(keys) > 1 else None
    if isinstance(inner, dict):
        _put(inner, keys[1:], value)
    elif isinstance(value, Mapping) and isinstance(data.get(keys[0]), dict):
        for name, item in value.items():
            _put(data[keys[0]], [name], item)
    else:
        data[keys[0]] = value


def _find(preset: str | Path) -> Path:
    text = str(preset)
    if text.endswith((".yaml", ".yml")) or "/" in text:
        path = Path(text)
        if not path.is_file():
            raise ConfigError(f"{path}: no such training preset")
        return path
    folder = resource_path("config", "training")
    path = folder / f"{text}.yaml"
    if not path.is_file():
        known = ", ".join(sorted(item.stem for item in folder.glob("*.yaml")))
        raise ConfigError(f"training preset {text!r}: unknown, shipped are: {known}")
    return path
