"""A learned policy for engines that start slowly: a network says whether the engine should run or
stand and what SOC is worth; the known plant gives the power of a running engine.

numpy only. Training: ``learning.run_or_stand``.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tractor_ems.policies.genset import power_max_w, running_fuel_kg_per_s
from tractor_ems.policies.mlp import Float32Array, Mlp, forward
from tractor_ems.policies.one_step import (
    HOLD_S,
    Held,
    cheapest,
    command_of,
    hold,
    not_held,
    running_range_w,
)
from tractor_ems.policies.q_policy import Normalisation, demand_inputs
from tractor_msgs_py.errors import PolicyError
from tractor_msgs_py.observation import Observation, ObservationSpec
from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.battery import open_circuit_v, soc_after
from tractor_sim.powertrain import Command, PowertrainParams

SLOPE_STEP = 0.01
"""Half the SOC over which the slope of the value is taken."""

SHORT_S, MIDDLE_S = 120.0, 600.0
"""Scales on which the network sees time running out, beside the whole horizon."""

TIME_INPUTS = 3


@dataclass(frozen=True)
class Prices:
    """What SOC, starts and a missed target are worth.

    Attributes:
        soc_kg: fuel for one unit of SOC [kg]; start_kg: of a start [kg].
        end_kg: of a SOC error at the end, per SOC^2 [kg]; 0 without a planned end.
        ease_kg_s: fuel that moving SOC loses in the battery, per SOC^2 per second of it [kg s].
        unit_kg: cost that networks see as 1 [kg].
    """

    soc_kg: float
    start_kg: float
    end_kg: float
    ease_kg_s: float
    unit_kg: float = 0.010

    def __post_init__(self) -> None:
        for name in ("soc_kg", "start_kg", "end_kg", "ease_kg_s", "unit_kg"):
            value = getattr(self, name)
            least = 1e-9 if name in ("ease_kg_s", "unit_kg") else 0.0
            if not least <= value <= 1e9:
                raise PolicyError(f"prices.{name}: {value}, allowed {least:g}..1e9")


def prices_of(params: PowertrainParams, price: float, end_kg: float) -> Prices:
    """Prices of a powertrain: SOC at ``price`` times the marginal fuel of a running engine at
    middle power, losses of P^2 R / V^2 at that fuel."""
    most_w = power_max_w(params)
    low_w, high_w = 0.1 * most_w, 0.5 * most_w
    low, high = running_fuel_kg_per_s(params, np.array([low_w, high_w]))
    marginal = float(high - low) / (high_w - low_w)
    battery = params.battery
    ocv_v = float(open_circuit_v(battery, np.array([params.soc_initial]))[0])
    return Prices(
        soc_kg=price * marginal * battery.charge_c * ocv_v,
        start_kg=params.engine.start_fuel_kg,
        end_kg=end_kg,
        ease_kg_s=max(marginal * battery.resistance_ohm * battery.charge_c**2, 1e-6),
    )


def stiffness_kg(prices: Prices, time_left_s: FloatArray) -> FloatArray:
    """Least cost per SOC^2 of a SOC error with so much time left, the shape of it [kg].

    Closing an error e evenly over t loses ease e^2 / t, leaving a rest r costs end r^2: the best
    of both is e^2 / (1 / end + t / ease).
    """
    found: FloatArray = prices.end_kg / (1.0 + time_left_s * (prices.end_kg / prices.ease_kg_s))
    return found


def time_inputs(time_left_s: FloatArray, horizon_s: float) -> Float32Array:
    """Time left (B,) as network inputs, (B, 3); farther than the horizon looks like it."""
    t = np.clip(time_left_s, 0.0, horizon_s)
    columns = (t / horizon_s, np.exp(-t / SHORT_S), np.exp(-t / MIDDLE_S))
    return np.stack(columns, axis=1).astype(np.float32)


RESERVE_INPUTS, SOC_INPUTS = 2, 2

FAR_SOC = 0.2
"""SOC error at which the ends of the window begin to be felt."""


def soc_inputs(scaling: Normalisation, error: FloatArray) -> Float32Array:
    """SOC error of any shape as two network inputs, last: itself, and a fifth power that is small
    until the ends of the window are near, where the value bends."""
    far = error / FAR_SOC
    return np.stack((error / scaling.soc_scale, far**5), axis=-1).astype(np.float32)


def reserve_inputs(
    params: PowertrainParams, peak_w: FloatArray, since_s: FloatArray
) -> Float32Array:
    """What holding an engine remembers, (B,) each, as network inputs (B, 2): how far the recent
    peak is beyond the battery, how lately demand was that only an engine makes safe."""
    beyond = np.clip(peak_w / params.battery.power_max_w - 1.0, -1.0, 1.0)
    return np.stack((beyond, np.exp(-since_s / HOLD_S)), axis=1).astype(np.float32)


@dataclass(frozen=True)
class RunOrStand:
    """Runs or stands by the sign of the mean G of its networks; see ``learning.run_or_stand``.

    Attributes:
        params: the powertrain it was made for.
        spec: demand filters that it sees.
        nets: networks of (demand inputs, reserve inputs, time inputs, SOC error) with outputs V
            and G [units]; more than one are averaged.
        scaling: input normalisation.
        prices: see :class:`Prices`.
        horizon_s: farthest time left that it knows; 0: it knows of no planned end.
        metadata: where it came from, as stored in its file.

    Raises PolicyError where a network does not fit the spec.
    """

    params: PowertrainParams
    spec: ObservationSpec
    nets: tuple[Mlp, ...]
    scaling: Normalisation
    prices: Prices
    horizon_s: float = 0.0
    metadata: dict[str, Any] = field(default_factory=dict, compare=False)

    def __post_init__(self) -> None:
        if not (np.isfinite(self.horizon_s) and self.horizon_s >= 0.0):
            raise PolicyError(f"horizon_s: {self.horizon_s}, must be finite and >= 0")
        known = RESERVE_INPUTS + (TIME_INPUTS if self.horizon_s else 0)
        wanted = (1 + len(self.spec.filters) + known + SOC_INPUTS, 2)
        for net in self.nets:
            if (net.inputs, net.outputs) != wanted:
                raise PolicyError(
                    f"network maps {net.inputs} inputs to {net.outputs} outputs, {self.name} with "
                    f"this observation needs {wanted[0]} to {wanted[1]}"
                )
        if not self.nets:
            raise PolicyError(f"{self.name}: no network")

    @property
    def name(self) -> str:
        """``ddqn_counterfactual``, or ``ddqn_unplanned`` where no planned end is known."""
        return "ddqn_counterfactual" if self.horizon_s else "ddqn_unplanned"

    def init(self, batch: int) -> Held:
        """No demand seen."""
        return not_held(batch)

    def act(self, observation: Observation, state: Held) -> tuple[Command, Held]:
        """Run at the cheapest power, or stand."""
        params, demand_w = self.params, observation.power_demand_w
        kept, held = hold(params, observation, state)
        inputs = np.concatenate(
            (
                demand_inputs(self.scaling, demand_w, observation.features),
                reserve_inputs(params, held.peak_w, held.since_s),
            ),
            axis=1,
        )
        left_s = np.broadcast_to(observation.time_left_s, demand_w.shape)
        stiff_kg = np.zeros(demand_w.shape)
        if self.horizon_s:
            inputs = np.concatenate((inputs, time_inputs(left_s, self.horizon_s)), axis=1)
            stiff_kg = stiffness_kg(self.prices, np.clip(left_s, 0.0, self.horizon_s))
        v, g = self._values(inputs, observation.soc, observation.soc_target)
        value = np.where(kept[:, None], v, np.minimum(v, v - g)) * self.prices.unit_kg
        slope = (value[:, 2] - value[:, 0]) / (2.0 * SLOPE_STEP)
        slope += 2.0 * stiff_kg * (observation.soc - observation.soc_target)
        per_soc = (self.prices.soc_kg - slope)[:, None]

        def after(battery_w: FloatArray) -> FloatArray:
            soc = np.broadcast_to(observation.soc[:, None], battery_w.shape)
            cost: FloatArray = per_soc * (
                soc - soc_after(params.battery, soc, battery_w, params.dt_s)
            )
            return cost

        least_w, most_w, may_run, may_be_off = running_range_w(params, observation)
        engine_w, _ = cheapest(params, demand_w, least_w, most_w, after)
        wants = g[:, 1] < np.where(
            observation.engine_on, 0.0, -self.prices.start_kg / self.prices.unit_kg
        )
        run = (wants | kept | ~may_be_off) & may_run
        return command_of(demand_w, engine_w, run), held

    def _values(
        self, inputs: Float32Array, soc: FloatArray, soc_target: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Mean V and G at SOC - step, SOC, SOC + step, (B, 3) each [units]."""
        steps = SLOPE_STEP * np.array([-1.0, 0.0, 1.0])
        error = soc_inputs(self.scaling, soc[:, None] + steps - soc_target[:, None])
        rows = np.concatenate(
            (np.repeat(inputs, 3, axis=0), error.reshape(-1, SOC_INPUTS)), axis=1
        )
        outputs = [forward(net, rows).reshape(len(soc), 3, 2) for net in self.nets]
        mean: FloatArray = np.mean(np.stack(outputs), axis=0, dtype=np.float64)
        return mean[..., 0], mean[..., 1]
