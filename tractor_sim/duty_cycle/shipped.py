"""Which listed cycle a demand is, by content: a renamed, rounded or shifted copy is no new cycle.

The hashes stand in config/cycle/hashes.json, so that a look-up computes no cycle and another
machine can check that it makes the same ones. ``python -m tractor_sim.duty_cycle.shipped`` writes
the file anew.
"""

import json
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

from tractor_msgs_py.atomic import write_json
from tractor_msgs_py.errors import ConfigError, CycleError
from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.duty_cycle.cycle import DutyCycle, cycle_hash, demand_fingerprint
from tractor_sim.duty_cycle.library import cycle_names, listed_cycles, load_cycle
from tractor_sim.resources import resource_path


@dataclass(frozen=True)
class Hashes:
    """What names a cycle's content: see ``cycle_hash`` and ``demand_fingerprint``."""

    sha256: str
    fingerprint: str


def hashes_of(cycle: DutyCycle) -> Hashes:
    """Hashes of a cycle, computed."""
    return Hashes(cycle_hash(cycle), demand_fingerprint(cycle.power_demand_w, cycle.dt_s))


@lru_cache(maxsize=1)
def published_hashes() -> dict[str, Hashes]:
    """Name of every listed cycle to its hashes, as committed.

    Raises:
        ConfigError: the file is not what it should be, or lists other cycles than splits.yaml.
    """
    path = resource_path("config", "cycle", "hashes.json")
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        found = {name: Hashes(*row.split()) for name, row in document["cycles"].items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ConfigError(f"{path}: not a list of cycle hashes ({error})") from None
    differ = set(found) ^ set(cycle_names())
    if differ:
        raise ConfigError(
            f"{path}: {min(differ)} is not both here and in splits.yaml; write the file anew: "
            "python -m tractor_sim.duty_cycle.shipped"
        )
    return found


def write_hashes(path: Path) -> None:
    """Compute every listed cycle and write its hashes; takes some seconds."""
    rows = {name: hashes_of(load_cycle(name)) for name in cycle_names()}
    write_json(path, {"cycles": {name: f"{h.sha256} {h.fingerprint}" for name, h in rows.items()}})


@lru_cache(maxsize=1)
def _names() -> dict[str, str]:
    """SHA-256 or fingerprint of every listed cycle to its name."""
    return {
        key: name for name, h in published_hashes().items() for key in (h.sha256, h.fingerprint)
    }


@lru_cache(maxsize=1)
def _held_out() -> tuple[frozenset[str], frozenset[str]]:
    rows = listed_cycles("held_out")
    return frozenset(row.name for row in rows), frozenset(row.operation for row in rows)


def listed_name(power_demand_w: FloatArray, dt_s: float) -> str | None:
    """Name of the listed cycle with this demand, rounded to watts and up to a constant."""
    return _names().get(demand_fingerprint(power_demand_w, dt_s))


def held_out_name(
    power_demand_w: FloatArray, dt_s: float, recorded_hash: str = "", recorded_name: str = ""
) -> str | None:
    """Name of the held-out cycle that a recording drives, or None.

    By what it holds, by the cycle hash that its plant announced, or by the name that it
    announced: any of them is enough, as one alone can be missing. The name also tells unlisted
    seeds of a held-out operation. A part of a recording that announces nothing is not known.

    Args:
        power_demand_w: shape (T,); auxiliaries may be in it [W].
        dt_s: step length [s].
        recorded_hash, recorded_name: of ``run_info``; empty where there is none.
    """
    names, operations = _held_out()
    for name in (_names().get(recorded_hash), listed_name(power_demand_w, dt_s)):
        if name in names:
            return name
    operation, _, seed = recorded_name.rpartition("_")
    return recorded_name if operation in operations and seed.isdigit() else None


def refuse_held_out(cycle: DutyCycle) -> None:
    """For whatever trains or tunes on a cycle.

    Raises:
        CycleError: the cycle is held out, by split, content or name.
    """
    name = held_out_name(cycle.power_demand_w, cycle.dt_s, recorded_name=cycle.name)
    if name is not None or cycle.split == "held_out":
        raise CycleError(
            f"cycle {cycle.name}: is {name or cycle.name}, a held-out cycle that training and "
            "tuning must not see"
        )


def with_shipped_split(cycle: DutyCycle) -> DutyCycle:
    """The cycle itself; with operation, split and seed of the listed one it equals, if any."""
    if cycle.split is not None:
        return cycle
    name = listed_name(cycle.power_demand_w, cycle.dt_s)
    if name is None:
        return cycle
    shipped = load_cycle(name)
    return replace(
        cycle,
        operation=shipped.operation,
        split=shipped.split,
        seed=shipped.seed,
        area_ha=shipped.area_ha,
    )


if __name__ == "__main__":
    write_hashes(resource_path("config", "cycle") / "hashes.json")
