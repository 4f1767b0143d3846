"""Published cycles (WHTC, parts of NRTC, ISO 8178 C1) in absolute power for one engine size.

They are printed as normalised engine speed and torque; config/cycle/published.yaml says which
engine makes watts of them. No second that was not published is made up.
"""

import csv
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from tractor_msgs_py.errors import ConfigError, CycleError
from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.config import describe
from tractor_sim.duty_cycle.cycle import DutyCycle, Split
from tractor_sim.resources import resource_path
from tractor_sim.yaml_file import read_yaml

FILE_NAME = r"^[A-Za-z0-9_]+\.csv$"
SOURCES = {
    "whtc": "World Harmonised Transient Cycle, UN R49 / GTR 4",
    "nrtc": "EPA Nonroad Transient Cycle, 40 CFR 1039 App. VI, only the published seconds at hand",
    "modes": "ISO 8178 type C1, modes as steps of weight times duration",
}


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class _Engine(_Strict):
    full_load: Annotated[str, Field(pattern=FILE_NAME)]
    rated_power_w: Annotated[float, Field(gt=0, le=1e7)]
    idle_rpm: Annotated[float, Field(gt=0, le=1e4)]


class _Transient(_Strict):
    kind: Literal["whtc", "nrtc"]
    file: Annotated[str, Field(pattern=FILE_NAME)]
    first_s: Annotated[int, Field(ge=0)]
    last_s: Annotated[int, Field(ge=0)]


class _Modes(_Strict):
    kind: Literal["modes"]
    file: Annotated[str, Field(pattern=FILE_NAME)]
    duration_s: Annotated[int, Field(gt=0, le=1_000_000)]
    transition_s: Annotated[int, Field(ge=0, le=3600)]


class _Published(_Strict):
    engine: _Engine
    cycles: dict[str, Annotated[_Transient | _Modes, Field(discriminator="kind")]]


@dataclass(frozen=True)
class FullLoad:
    """Greatest torque of an engine over its speed.

    Attributes:
        speed_rpm: rising knots, shape (K,).
        torque_nm: at the knots, linear in between, shape (K,).
        idle_rpm: idling speed.
    """

    speed_rpm: FloatArray
    torque_nm: FloatArray
    idle_rpm: float

    def power_w(self, speed_rpm: FloatArray) -> FloatArray:
        """Greatest power at a speed; the torque of the nearest end outside the curve [W]."""
        torque_nm = np.interp(speed_rpm, self.speed_rpm, self.torque_nm)
        return np.asarray(torque_nm * speed_rpm * (np.pi / 30.0))

    @property
    def rated_rpm(self) -> float:
        """Speed of greatest power among the knots."""
        return float(self.speed_rpm[np.argmax(self.power_w(self.speed_rpm))])

    @property
    def intermediate_rpm(self) -> float:
        """Speed of greatest torque, but within 60..75 % of rated speed (ISO 8178-4)."""
        peak = float(self.speed_rpm[np.argmax(self.torque_nm)])
        return float(np.clip(peak, 0.60 * self.rated_rpm, 0.75 * self.rated_rpm))


def published_cycle(name: str, split: Split | None = None) -> DutyCycle:
    """A published cycle by name, demand at the bus in whole watts, dt 1 s.

    Raises:
        CycleError: no such published cycle.
        ConfigError: the configuration or a data file is wrong.
    """
    config = _config()
    operation = published_operation(name)
    entry = config.cycles[name]
    curve = full_load()
    if isinstance(entry, _Modes):
        demand_w = modes_demand_w(curve, _rows(entry.file), entry.duration_s, entry.transition_s)
    else:
        demand_w = _transient_demand_w(curve, entry)
    rated_kw = config.engine.rated_power_w / 1e3
    return DutyCycle(
        name=name,
        power_demand_w=np.round(demand_w) + 0.0,
        dt_s=1.0,
        operation=operation,
        split=split,
        source=f"{SOURCES[entry.kind]}; scaled to {rated_kw:g} kW",
    )


def published_operation(name: str) -> str:
    """Operation of a published cycle: the test cycle that it is, or is a part of.

    Raises:
        CycleError: no such published cycle.
    """
    cycles = _config().cycles
    if name not in cycles:
        raise CycleError(f"cycle {name!r}: unknown, published are {', '.join(cycles)}")
    kind = cycles[name].kind
    return name if kind == "modes" else kind


def full_load() -> FullLoad:
    """The configured engine's full-load curve, its torque scaled to the rated power.

    Raises:
        ConfigError: the configuration or the curve's file is wrong.
    """
    engine = _config().engine
    rows = _rows(engine.full_load)
    speed_rpm = np.array([float(row["speed_rpm"]) for row in rows])
    torque_nm = np.array([float(row["max_torque_nm"]) for row in rows])
    unscaled = FullLoad(speed_rpm, torque_nm, engine.idle_rpm)
    scale = engine.rated_power_w / unscaled.power_w(speed_rpm).max()
    return FullLoad(speed_rpm, torque_nm * scale, engine.idle_rpm)


def whtc_speed_rpm(curve: FullLoad, speed_norm: FloatArray) -> FloatArray:
    """Engine speed of normalised WHTC speed (UN R49, Annex 4) [rpm].

    n_lo is the lowest speed with 55 % of greatest power, n_hi the highest with 70 %, n_pref the
    one at which torque integrated from idle is 51 % of that up to the highest speed with 95 %. A
    curve that ends above 70 or 95 % stands for n_hi and n_95h with its end.
    """
    fine = np.arange(curve.idle_rpm, curve.speed_rpm[-1] + 1.0)
    power_w = curve.power_w(fine)
    share = power_w / power_w.max()
    n_lo = fine[share >= 0.55][0]
    n_hi = fine[share >= 0.70][-1]
    below_95h = fine <= fine[share >= 0.95][-1]
    area = np.cumsum(np.interp(fine[below_95h], curve.speed_rpm, curve.torque_nm))
    n_pref = fine[below_95h][np.searchsorted(area, 0.51 * area[-1])]
    span = 0.45 * n_lo + 0.45 * n_pref + 0.1 * n_hi - curve.idle_rpm
    return np.asarray(speed_norm * span * 2.0327 + curve.idle_rpm)


def nrtc_speed_rpm(curve: FullLoad, speed_norm: FloatArray) -> FloatArray:
    """Engine speed of normalised NRTC speed; 100 % is the speed of greatest power [rpm]."""
    return np.asarray(speed_norm * (curve.rated_rpm - curve.idle_rpm) + curve.idle_rpm)


def modes_demand_w(
    curve: FullLoad, rows: list[dict[str, str]], duration_s: int, transition_s: int
) -> FloatArray:
    """Modes as steps joined by ramps, idling halved to both ends, shape (duration,) [W].

    Samples are means over their second, so that the energy of the steps is kept exactly.

    Raises:
        ConfigError: the weights do not sum to one, or a mode is shorter than a transition.
    """
    speeds = {
        "rated": curve.rated_rpm,
        "intermediate": curve.intermediate_rpm,
        "idle": curve.idle_rpm,
    }
    steps = [
        (
            float(row["weight"]),
            float(curve.power_w(np.array(speeds[row["engine_speed"]])))
            * float(row["torque_pct_of_max_at_speed"])
            / 100.0,
        )
        for row in rows
        if row["engine_speed"] != "idle"
    ]
    idle = 1.0 - sum(weight for weight, _ in steps)
    steps = [(idle / 2, 0.0), *steps, (idle / 2, 0.0)]
    if idle <= 0 or min(weight for weight, _ in steps) * duration_s < transition_s:
        raise ConfigError(
            f"published.yaml: duration_s {duration_s}, a mode of it is shorter than the "
            f"transition_s {transition_s}, or idling has no share"
        )
    border_s = np.cumsum([weight for weight, _ in steps])[:-1] * duration_s
    power_w = np.array([power for _, power in steps])
    half = max(transition_s / 2.0, 1e-6)
    knot_s = np.concatenate(([0.0], np.ravel(np.column_stack((border_s - half, border_s + half)))))
    knot_s = np.append(knot_s, duration_s)
    knot_w = np.repeat(power_w, 2)
    energy_j = np.concatenate(
        ([0.0], np.cumsum(np.diff(knot_s) * (knot_w[1:] + knot_w[:-1]) / 2.0))
    )
    edge_s = np.arange(duration_s + 1.0)
    at = np.clip(np.searchsorted(knot_s, edge_s, side="right") - 1, 0, len(knot_s) - 2)
    into_s = edge_s - knot_s[at]
    slope = (knot_w[at + 1] - knot_w[at]) / (knot_s[at + 1] - knot_s[at])
    return np.diff(energy_j[at] + into_s * (knot_w[at] + slope * into_s / 2.0))


def _transient_demand_w(curve: FullLoad, entry: _Transient) -> FloatArray:
    rows = [
        row for row in _rows(entry.file) if entry.first_s <= int(row["time_s"]) <= entry.last_s
    ]
    seconds = [int(row["time_s"]) for row in rows]
    if seconds != list(range(entry.first_s, entry.last_s + 1)):
        raise ConfigError(
            f"{entry.file}: lacks seconds of {entry.first_s}..{entry.last_s}, has {len(seconds)}"
        )
    speed_norm = np.array([float(row["speed_norm_pct"]) for row in rows]) / 100.0
    # An empty torque is motoring: the engine would be dragged, which asks nothing of the bus.
    torque_norm = np.array([float(row["torque_norm_pct"] or 0.0) for row in rows]) / 100.0
    to_rpm = whtc_speed_rpm if entry.kind == "whtc" else nrtc_speed_rpm
    return torque_norm * curve.power_w(to_rpm(curve, speed_norm))


@lru_cache(maxsize=1)
def _config() -> _Published:
    path = resource_path("config", "cycle", "published.yaml")
    try:
        return _Published.model_validate(read_yaml(path))
    except ValidationError as error:
        raise ConfigError(f"{path}: {describe(error)}") from None


@lru_cache(maxsize=8)
def _rows(file: str) -> list[dict[str, str]]:
    path: Path = resource_path("data", "cycle", file)
    with path.open(newline="", encoding="utf-8") as opened:
        return list(csv.DictReader(opened))
