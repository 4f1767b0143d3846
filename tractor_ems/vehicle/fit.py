"""A vehicle's parameters from a recording: what it says, how well, and what it cannot say.

Every score against an optimum rests on the model, so what was not seen is named, never guessed.
"""

from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from tractor_ems.vehicle.estimate import Estimate
from tractor_ems.vehicle.fit_battery import BatteryFit, fit_battery
from tractor_ems.vehicle.fit_fuel import FuelFit, fit_fuel
from tractor_ems.vehicle.recorded import Recorded, read_recorded
from tractor_sim.config import load_powertrain
from tractor_sim.powertrain import PowertrainParams

DIESEL_LHV_J_PER_KG = 42.7e6
"""Assumed where no powertrain is given; only efficiencies depend on it, never fuel."""


@dataclass(frozen=True)
class VehicleFit:
    """What one bag says about the vehicle it was recorded on.

    Attributes:
        bag: its path.
        recorded: the steps it holds.
        base: the powertrain that gives the rest; None: none was named.
        fuel, battery: the fits.
        estimates: every parameter with value, error and verdict.
    """

    bag: str
    recorded: Recorded
    base: PowertrainParams | None
    fuel: FuelFit
    battery: BatteryFit
    estimates: tuple[Estimate, ...]

    @property
    def not_identified(self) -> tuple[Estimate, ...]:
        """What the recording cannot say."""
        return tuple(item for item in self.estimates if item.verdict == "not_identified")

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        fuel, battery, on = self.fuel, self.battery, self.recorded.engine_on
        return {
            "bag": self.bag,
            "runs": self.recorded.runs,
            "steps": len(self.recorded),
            "steps_on": int(on.sum()),
            "starts": fuel.starts,
            "powertrain": self.recorded.info.powertrain,
            "rest_from": None if self.base is None else self.base.name,
            "estimates": [asdict(item) for item in self.estimates],
            "not_identified": [item.name for item in self.not_identified],
            "notes": list(battery.notes),
            "fuel_curve": {
                "bus_power_w": fuel.bus_w.tolist(),
                "fuel_kg_per_s": fuel.fuel_kg_per_s.tolist(),
                "error_kg_per_s": fuel.error_kg_per_s.tolist(),
                "residual_rms_kg_per_s": fuel.rms_kg_per_s,
                "not_convex_residual_rms_kg_per_s": fuel.free_rms_kg_per_s,
                "never_visited_w": [list(gap) for gap in fuel.gaps_w],
            },
            "ocv": {
                "soc": battery.ocv_soc.tolist(),
                "voltage_v": battery.ocv_v.tolist(),
                "error_v": battery.ocv_error_v.tolist(),
                "residual_rms_v": battery.rms_v,
                "soc_residual_rms": battery.rms_soc,
            },
        }


def fit(bag: Path, powertrain: str | None = None) -> VehicleFit:
    """Estimate what a bag's steps support.

    Args:
        powertrain: name or file of what the rest is taken from, generator and heating value
            among it.

    Raises:
        BagError: the bag cannot be read, holds demand alone, or runs of several powertrains.
        ConfigError: the powertrain cannot be read.
    """
    base = None if powertrain is None else load_powertrain(powertrain)
    recorded = read_recorded(bag)
    lhv = DIESEL_LHV_J_PER_KG if base is None else base.engine.fuel_lhv_j_per_kg
    fuel, battery = fit_fuel(recorded, lhv), fit_battery(recorded)
    estimates = (
        *fuel.estimates,
        *_engine_bounds(recorded),
        *battery.estimates,
        *_limits(recorded),
        *_unseen(recorded, base),
    )
    return VehicleFit(str(bag), recorded, base, fuel, battery, estimates)


def _engine_bounds(recorded: Recorded) -> list[Estimate]:
    """Ramp and minimum times: what was seen bounds them."""
    on, same = recorded.engine_on, np.diff(recorded.stretch) == 0
    both = on[1:] & on[:-1] & same
    moved = np.abs(np.diff(recorded.engine_w))[both] / recorded.dt_s[1:][both]
    ramp = float(moved.max()) if len(moved) else None
    found = [
        Estimate(
            "engine.ramp_w_per_s, at the bus",
            ramp,
            None,
            "not_identified" if ramp is None else "bound",
            "no two steps on in a row" if ramp is None else "at least the fastest change seen",
        )
    ]
    for name, state in (("engine.min_on_s", on), ("engine.min_off_s", ~on)):
        seconds = _shortest_s(state, recorded)
        found.append(
            Estimate(
                name,
                seconds,
                None,
                "not_identified" if seconds is None else "bound",
                "no such period with both its ends"
                if seconds is None
                else "at most the shortest such period seen",
            )
        )
    return found


def _shortest_s(state: Any, recorded: Recorded) -> float | None:
    """Shortest period in ``state`` that begins and ends inside one stretch."""
    shortest: float | None = None
    for number in np.unique(recorded.stretch):
        inside = recorded.stretch == number
        within, dt_s = state[inside], recorded.dt_s[inside]
        edges = np.flatnonzero(within[1:] != within[:-1]) + 1
        for first, last in pairwise(edges):
            if within[first]:
                seconds = float(dt_s[first:last].sum())
                shortest = seconds if shortest is None else min(shortest, seconds)
    return shortest


def _limits(recorded: Recorded) -> list[Estimate]:
    """Largest limits that the vehicle published, and how often."""
    found = []
    for name, values in (
        ("engine.power_max_w, at the bus", recorded.engine_limit_w),
        ("battery.power_max_w, charging", recorded.charge_limit_w),
        ("battery.power_max_w, discharging", recorded.discharge_limit_w),
    ):
        largest = float(values.max())
        times = int(np.sum(values >= largest * (1.0 - 1e-9)))
        why = f"largest limit that the vehicle published, in {times} of {len(values)} steps"
        found.append(Estimate(name, largest, None, "announced", why))
    return found


def _ends_seen(recorded: Recorded) -> str:
    """Where a limit fell to a hundredth of its largest: an end of the window is near."""
    text = ""
    for way, limit in (
        ("charge", recorded.charge_limit_w),
        ("discharge", recorded.discharge_limit_w),
    ):
        least = int(np.argmin(limit))
        if limit[least] < 0.01 * limit.max():
            text += (
                f"; {way} limit fell to {limit[least]:.4g} W at {recorded.soc_before[least]:.4f}"
            )
    return text or "; neither limit fell to 0: no end of the window was seen"


def _unseen(recorded: Recorded, base: PowertrainParams | None) -> list[Estimate]:
    """What no recording at the bus can say."""
    rest = "assumed" if base is None else f"from powertrain {base.name}"
    at_bus = "the recording is of the bus: losses before it are inside the fuel curve"
    return [
        Estimate("generator.curve_efficiency", None, None, "not_identified", at_bus),
        Estimate(
            "engine.fuel_lhv_j_per_kg",
            DIESEL_LHV_J_PER_KG if base is None else base.engine.fuel_lhv_j_per_kg,
            None,
            "not_identified",
            f"{rest}; fuel is recorded as mass",
        ),
        Estimate(
            "p_aux_w",
            recorded.info.p_aux_w,
            None,
            "announced",
            "demand on the bus contains the auxiliaries; how much is not seen in it",
        ),
        Estimate(
            "battery.soc_min, battery.soc_max",
            None,
            None,
            "not_identified",
            f"visited {recorded.soc.min():.4f}..{recorded.soc.max():.4f}" + _ends_seen(recorded),
        ),
    ]
