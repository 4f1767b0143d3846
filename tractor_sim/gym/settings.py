"""What an environment is made of: the keyword arguments of ``gymnasium.make``, checked once."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from tractor_msgs_py.errors import ConfigError
from tractor_sim.config import load_powertrain
from tractor_sim.duty_cycle.library import cycle_names, listed_cycles, load_cycle, operations
from tractor_sim.engine import fuel_rate_kg_per_s
from tractor_sim.generator import to_bus_w
from tractor_sim.powertrain import PowertrainParams

ActionKind = Literal["engine", "battery"]
ACTION_COUNT: dict[ActionKind, int] = {"engine": 21, "battery": 1600}

FIRST_SEED, SEEDS = 1_000_000, 1000
"""Seeds that ``operations`` draws from: far above every listed one."""


@dataclass(frozen=True)
class Settings:
    """Settings of an environment; the fields are the keyword arguments of ``gymnasium.make``.

    Attributes:
        powertrain: name, with settings behind a colon, or YAML file.
        cycles: names or CSV files; None with no ``operations``: every training cycle.
        operations: instead of ``cycles``, operations whose seeds are drawn, 1,000 of each.
        soc_initial: at the start of an episode, one value or (lowest, highest) to draw from;
            None: the powertrain's.
        soc_target: what the battery energy is priced against; None: the powertrain's, or else
            where the episode started.
        actions: ``engine``: off and powers of the engine. ``battery``: the paper's grid.
        action_count: None: 21 engine actions or 1600 battery actions.
        equivalence_kg_per_j: fuel that one joule in the battery is worth at the target SOC, > 0;
            None: the engine's best specific fuel at the bus [kg/J].
        soc_slope: relative rise of that price per unit of SOC below the target, >= 0.
        start_price_kg: price of an engine start besides its fuel, >= 0 [kg].
        shortfall_factor: price of undelivered energy in units of ``equivalence_kg_per_j``, >= 0.
        reward_unit_kg: fuel that is a reward of -1, > 0 [kg].
    """

    powertrain: str = "field"
    cycles: tuple[str, ...] | None = None
    operations: tuple[str, ...] | None = None
    soc_initial: float | tuple[float, float] | None = None
    soc_target: float | None = None
    actions: ActionKind = "engine"
    action_count: int | None = None
    equivalence_kg_per_j: float | None = None
    soc_slope: float = 3.0
    start_price_kg: float = 0.0
    shortfall_factor: float = 10.0
    reward_unit_kg: float = 0.010

    @property
    def count(self) -> int:
        """Number of actions."""
        return ACTION_COUNT[self.actions] if self.action_count is None else self.action_count


def make_settings(**kwargs: Any) -> tuple[Settings, PowertrainParams]:
    """Checked settings and their powertrain.

    Raises:
        ConfigError: unknown name or value out of its range; the message names both.
        CycleError: no such cycle.
    """
    known = [field.name for field in dataclasses.fields(Settings)]
    for name in kwargs:
        if name not in known:
            raise ConfigError(f"SeriesHybrid: no setting {name!r}, allowed {', '.join(known)}")
    for name in ("cycles", "operations"):
        if kwargs.get(name) is not None:
            kwargs[name] = _names(name, kwargs[name])
    settings = Settings(**kwargs)
    if not isinstance(settings.powertrain, str):
        raise ConfigError(f"SeriesHybrid: powertrain {settings.powertrain!r}, allowed a name")
    params = load_powertrain(settings.powertrain)
    _check_numbers(settings)
    _check_soc(settings, params)
    _check_cycles(settings)
    if settings.equivalence_kg_per_j is None:
        best = best_specific_fuel_kg_per_j(params)
        settings = dataclasses.replace(settings, equivalence_kg_per_j=best)
    return settings, params


def best_specific_fuel_kg_per_j(params: PowertrainParams) -> float:
    """Least fuel per joule at the bus [kg/J], to 1/4096 of the engine's power."""
    engine = params.engine
    crank_w = np.union1d(np.linspace(0.0, engine.power_max_w, 4097)[1:], engine.curve_power_w[1:])
    bus_w = to_bus_w(params.generator, crank_w, engine.power_max_w)
    return float(np.min(fuel_rate_kg_per_s(engine, crank_w) / bus_w))


def episode_names(settings: Settings) -> dict[str, list[str]]:
    """Cycles to draw from, by operation."""
    if settings.operations is not None:
        seeds = range(FIRST_SEED, FIRST_SEED + SEEDS)
        return {name: [f"{name}_{seed}" for seed in seeds] for name in settings.operations}
    if settings.cycles is not None:
        return {"": list(settings.cycles)}
    rows = listed_cycles("train")
    return {
        operation: [row.name for row in rows if row.operation == operation]
        for operation in dict.fromkeys(row.operation for row in rows)
    }


def _names(name: str, value: Any) -> tuple[str, ...]:
    names = (value,) if isinstance(value, str) else value
    if not (isinstance(names, Sequence) and names and all(isinstance(n, str) for n in names)):
        raise ConfigError(f"SeriesHybrid: {name} {value!r}, allowed a name or several")
    return tuple(names)


def _number(value: Any) -> bool:
    return isinstance(value, int | float | np.floating) and not isinstance(value, bool)


def _check_numbers(settings: Settings) -> None:
    if settings.actions not in get_args(ActionKind):
        raise ConfigError(f"SeriesHybrid: actions {settings.actions!r}, allowed engine, battery")
    count = settings.count
    if not isinstance(count, int) or isinstance(count, bool) or not 2 <= count <= 10_000:
        raise ConfigError(f"SeriesHybrid: action_count {count!r}, allowed 2..10000")
    ranges = {
        "equivalence_kg_per_j": (0.0, 1e-6, False),
        "soc_slope": (0.0, 100.0, True),
        "start_price_kg": (0.0, 1.0, True),
        "shortfall_factor": (0.0, 1e6, True),
        "reward_unit_kg": (0.0, 1e3, False),
    }
    for name, (least, most, with_least) in ranges.items():
        value = getattr(settings, name)
        if value is None and name == "equivalence_kg_per_j":
            continue
        if not (_number(value) and (least < value <= most or (with_least and value == least))):
            sign = "<=" if with_least else "<"
            raise ConfigError(
                f"SeriesHybrid: {name} {value!r}, allowed {least:g} {sign} value <= {most:g}"
            )


def _check_soc(settings: Settings, params: PowertrainParams) -> None:
    low, high = params.battery.soc_min, params.battery.soc_max
    wanted = settings.soc_initial
    pair: Any = wanted if isinstance(wanted, tuple | list) else (wanted, wanted)
    if wanted is not None and not (
        len(pair) == 2 and all(map(_number, pair)) and low <= pair[0] <= pair[1] <= high
    ):
        raise ConfigError(
            f"SeriesHybrid: soc_initial {wanted!r}, allowed {low}..{high} or two of these"
        )
    target = settings.soc_target
    if target is not None and not (_number(target) and low <= target <= high):
        raise ConfigError(f"SeriesHybrid: soc_target {target!r}, allowed {low}..{high}")


def _check_cycles(settings: Settings) -> None:
    if settings.cycles is not None and settings.operations is not None:
        raise ConfigError("SeriesHybrid: cycles and operations, allowed one of them")
    listed = set(cycle_names())
    for name in settings.cycles or ():
        if name not in listed:
            load_cycle(name)  # says what is wrong with a file or name
    held_out = {row.operation for row in listed_cycles("held_out")}
    for name in settings.operations or ():
        if name not in operations():
            allowed = ", ".join(item for item in operations() if item not in held_out)
            raise ConfigError(f"SeriesHybrid: operations {name!r}, allowed {allowed}")
        if name in held_out:
            raise ConfigError(
                f"SeriesHybrid: operations {name!r} is held out, no training draws from it; "
                "to evaluate name its cycles in cycles="
            )


def soc_range(settings: Settings, params: PowertrainParams) -> tuple[float, float]:
    """Lowest and highest SOC that an episode may start at."""
    wanted = params.soc_initial if settings.soc_initial is None else settings.soc_initial
    low, high = wanted if isinstance(wanted, tuple | list) else (wanted, wanted)
    return float(low), float(high)


def target_soc(settings: Settings, params: PowertrainParams) -> float:
    """What an episode should end at; NaN: where it started."""
    target = params.soc_target if settings.soc_target is None else settings.soc_target
    return math.nan if target is None else float(target)
