"""Which shipped cycle a demand is, by content: a renamed copy is no new cycle."""

from dataclasses import replace
from functools import lru_cache

from tractor_sim.duty_cycle.cycle import DutyCycle, cycle_hash
from tractor_sim.duty_cycle.library import cycle_names, load_cycle


@lru_cache(maxsize=1)
def shipped_by_hash() -> dict[str, str]:
    """Hash of every shipped cycle to its name."""
    return {cycle_hash(load_cycle(name)): name for name in cycle_names()}


def with_shipped_split(cycle: DutyCycle) -> DutyCycle:
    """The cycle itself; with operation, split and seed of the shipped one it equals, if any."""
    if cycle.split is not None:
        return cycle
    name = shipped_by_hash().get(cycle_hash(cycle))
    if name is None:
        return cycle
    shipped = load_cycle(name)
    return replace(cycle, operation=shipped.operation, split=shipped.split, seed=shipped.seed)
