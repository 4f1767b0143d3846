"""Disturbances that policies know nothing of: another plant, wrong signals, late commands. Each is
declared in the study's settings; here is what they do."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from tractor_ems.drive import Interference
from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.powertrain import PowertrainParams

_STRICT = ConfigDict(extra="forbid")

Factor = Annotated[float, Field(ge=0.1, le=10.0)]


@dataclass(frozen=True, config=_STRICT)
class Disturbance:
    """One disturbance; what is left at its default is undisturbed.

    Attributes:
        name: what tables call it.
        fuel, capacity, resistance: factors on the fuel rate of the running engine (a start's fuel
            stays), on the battery's energy, on its resistance.
        soc_bias: of the SOC that policies see, fraction.
        noise_w, noise_s: standard deviation and time constant of first-order noise on the demand
            that policies see [W], [s].
        delay_steps: age of a command when the plant gets it.
        end_factor: announced duration of the work over the real one.
    """

    name: Annotated[str, Field(pattern=r"^[a-z0-9_]+$")]
    fuel: Factor = 1.0
    capacity: Factor = 1.0
    resistance: Factor = 1.0
    soc_bias: Annotated[float, Field(ge=-0.2, le=0.2)] = 0.0
    noise_w: Annotated[float, Field(ge=0.0, le=1e5)] = 0.0
    noise_s: Annotated[float, Field(gt=0.0, le=3600.0)] = 1.0
    delay_steps: Annotated[int, Field(ge=0, le=60)] = 0
    end_factor: Factor = 1.0

    @property
    def plant(self) -> tuple[float, float, float]:
        """What it does to the plant; equal tuples are equal plants."""
        return self.fuel, self.capacity, self.resistance


NONE = Disturbance("none")


def disturbed(params: PowertrainParams, disturbance: Disturbance) -> PowertrainParams:
    """The plant as it really is."""
    engine, battery, fuel = params.engine, params.battery, disturbance.fuel
    engine = replace(
        engine,
        curve_fuel_kg_per_s=tuple(fuel * rate for rate in engine.curve_fuel_kg_per_s),
        curve_efficiency=tuple(eta / fuel for eta in engine.curve_efficiency),
        idle_fuel_kg_per_s=fuel * engine.idle_fuel_kg_per_s,
    )
    battery = replace(
        battery,
        energy_j=disturbance.capacity * battery.energy_j,
        resistance_ohm=disturbance.resistance * battery.resistance_ohm,
    )
    return replace(params, engine=engine, battery=battery)


def noise(
    disturbance: Disturbance, steps: int, dt_s: float, rng: np.random.Generator
) -> FloatArray:
    """Stationary first-order noise, shape (T,) [W]: n' = a n + sd sqrt(1 - a^2) w with
    a = exp(-dt / noise_s)."""
    keep = float(np.exp(-dt_s / disturbance.noise_s))
    draws = rng.standard_normal(steps)
    values = np.empty(steps)
    value = draws[0]
    for k in range(steps):
        value = draws[0] if k == 0 else keep * value + np.sqrt(1.0 - keep**2) * draws[k]
        values[k] = value
    return disturbance.noise_w * values


def interference_of(
    disturbances: Sequence[Disturbance], steps: int, dt_s: float, seeds: Sequence[int]
) -> Interference:
    """What policies are told wrong, one disturbance per tractor of a batch.

    Args:
        seeds: of the noise, one per tractor: the same for every policy.
    """
    noises = [
        noise(item, steps, dt_s, np.random.Generator(np.random.PCG64(seed)))
        if item.noise_w > 0.0
        else np.zeros(steps)
        for item, seed in zip(disturbances, seeds, strict=True)
    ]
    return Interference(
        demand_noise_w=np.stack(noises),
        soc_bias=np.array([item.soc_bias for item in disturbances]),
        delay_steps=np.array([item.delay_steps for item in disturbances], dtype=np.int64),
        end_factor=np.array([item.end_factor for item in disturbances]),
    )
