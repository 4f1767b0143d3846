"""What is driven: powertrain, cycle, initial SOC and target, from the words a user types."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tractor_msgs_py.errors import ConfigError, CycleError
from tractor_msgs_py.signals import SignalMap
from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.config import load_powertrain
from tractor_sim.duty_cycle.cycle import DutyCycle
from tractor_sim.duty_cycle.library import load_cycle
from tractor_sim.duty_cycle.shipped import with_shipped_split
from tractor_sim.powertrain import PowertrainParams


@dataclass(frozen=True)
class Scenario:
    """A cycle on a powertrain, and where SOC starts and should end.

    ``powertrain_source`` and ``cycle_source`` are what the user named, for the nodes.
    """

    params: PowertrainParams
    cycle: DutyCycle
    soc_initial: float
    soc_target: float
    powertrain_source: str
    cycle_source: str

    @property
    def power_demand_w(self) -> FloatArray:
        """Demand at the bus, auxiliaries included, shape (T,) [W]."""
        return self.cycle.power_demand_w + self.params.p_aux_w


def make_scenario(
    powertrain: str,
    cycle: str,
    soc_initial: float | None = None,
    soc_target: float | None = None,
    *,
    signals: SignalMap | None = None,
    namespace: str | None = None,
) -> Scenario:
    """Resolve names and files.

    Args:
        powertrain: shipped name or YAML file.
        cycle: shipped name, CSV file or bag folder.
        soc_initial: None: the powertrain's.
        soc_target: None: the powertrain's, or else the initial SOC.
        signals: the map of a vehicle, if the cycle is its bag; its demand is then sampled every
            step of the powertrain.
        namespace: of the map's relative topics; None: the only one that fits.

    Raises:
        ConfigError: unknown powertrain, or a SOC outside its window.
        CycleError: unknown or malformed cycle, or one of another step length.
        BagError: the bag cannot be read or holds no demand.
    """
    params = load_powertrain(powertrain)
    if signals is not None and is_bag(cycle):
        from tractor_ems.bags.sampled_traces import cycle_of_sampled_bag

        sampled = cycle_of_sampled_bag(Path(cycle), signals, params.dt_s, namespace)
        duty_cycle = with_shipped_split(sampled)
    else:
        duty_cycle = resolve_cycle(cycle)
    if abs(duty_cycle.dt_s - params.dt_s) > 1e-9:
        raise CycleError(
            f"cycle {duty_cycle.name}: dt_s {duty_cycle.dt_s}, powertrain {params.name} "
            f"steps by {params.dt_s} s (ems cycle import --dt {params.dt_s:g} resamples)"
        )
    initial = params.soc_initial if soc_initial is None else soc_initial
    default_target = initial if params.soc_target is None else params.soc_target
    target = default_target if soc_target is None else soc_target
    battery = params.battery
    for name, value in (("soc0", initial), ("soc target", target)):
        if not (np.isfinite(value) and battery.soc_min <= value <= battery.soc_max):
            raise ConfigError(f"{name}: {value}, allowed {battery.soc_min}..{battery.soc_max}")
    return Scenario(params, duty_cycle, initial, target, powertrain, cycle)


def resolve_cycle(text: str) -> DutyCycle:
    """A cycle by shipped name, CSV file, or bag (its power demand less the auxiliaries).

    A file that holds a shipped cycle's demand is in that cycle's split.
    """
    if is_bag(text):
        from tractor_ems.bags.transitions import cycle_of_bag

        return with_shipped_split(cycle_of_bag(Path(text)))
    return with_shipped_split(load_cycle(text))


def is_bag(text: str) -> bool:
    """Whether a cycle is named by a bag: a folder, or a storage file."""
    path = Path(text)
    return path.is_dir() or path.suffix in (".mcap", ".db3")
